//! The `splat4d` command line.
fn main() {}
