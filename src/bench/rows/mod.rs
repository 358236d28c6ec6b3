//! The ops, one entry per op and size.

mod basic;
mod density;
mod motion;
mod render;

pub(in crate::bench) use crate::check::mlp::NARROW;
pub(in crate::bench) use render::image as compare_image;

use super::job::Entry;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = basic::entries(quick);
    all.extend(render::entries(quick));
    all.extend(motion::entries(quick));
    all.extend(density::entries(quick));
    all
}

/// `1234567` as `1,234,567`.
pub(in crate::bench) fn thousands(number: usize) -> String {
    let digits = number.to_string();
    let first = digits.len() % 3;
    let (head, tail) = digits.split_at(if first == 0 { 3.min(digits.len()) } else { first });
    let groups = tail.as_bytes().chunks(3).map(|g| std::str::from_utf8(g).unwrap_or_default());
    std::iter::once(head).chain(groups).collect::<Vec<_>>().join(",")
}

/// The sizes of a full run, or the first of them.
fn sizes<T: Copy>(quick: bool, all: &[T]) -> Vec<T> {
    if quick { all[..1].to_vec() } else { all.to_vec() }
}
