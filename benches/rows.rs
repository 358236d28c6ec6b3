//! The rows of `splat4d bench` under `cargo bench`.
//!
//! The device is `SPLAT4D_DEVICE` (an index, a kind or part of a name; default: the best). Every row is
//! compared with the oracle first; a row that exceeds its bound is reported and not timed. The time is
//! host time, from submission to completion; `splat4d bench` reads device timestamps.

use divan::Bencher;
use splat4d::bench::{Entry, entries};
use splat4d::gpu::{Device, Request, Selector};
use std::cell::RefCell;
use std::sync::LazyLock;

static DEVICE: LazyLock<Device> = LazyLock::new(|| {
    let selector = Selector::from(std::env::var("SPLAT4D_DEVICE").as_deref().unwrap_or("best"));
    Device::open(&Request { selector, ..Request::default() }).expect("a Vulkan device")
});

static ENTRIES: LazyLock<Vec<Entry>> = LazyLock::new(|| entries(false));

fn main() {
    divan::main();
}

fn names() -> Vec<String> {
    ENTRIES.iter().map(|entry| format!("{}, {}", entry.id, entry.size)).collect()
}

#[divan::bench(args = names(), max_time = 1, min_time = 0.2)]
fn row(bencher: Bencher<'_, '_>, name: &String) {
    let at = names().iter().position(|other| other == name).expect("a name of the list");
    let job = match (ENTRIES[at].prepare)(&DEVICE, 0) {
        Ok(job) => job,
        Err(error) => return eprintln!("{name}: {error}"),
    };
    if !job.accuracy.passed() {
        let wrong = &job.accuracy;
        return eprintln!(
            "{name}: {:e} of the bound in {}: no speed",
            wrong.of_bound, wrong.output
        );
    }
    let job = RefCell::new(job);
    bencher
        .with_inputs(|| {
            if let Some(reset) = &mut job.borrow_mut().reset {
                reset().expect("an upload");
            }
        })
        .bench_local_values(|()| (job.borrow_mut().execute)().expect("a submission"));
}
