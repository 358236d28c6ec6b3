//! The `splat4d` command line.

mod cmd;

fn main() -> std::process::ExitCode {
    cmd::main()
}
