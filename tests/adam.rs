//! The Adam optimiser against its oracle.

mod common;

use splat4d::ops::adam::{Adam, AdamArgs};
use splat4d::types::AdamSettings;

common::cases! { "adam", folded to 40: steps, visible, gate, hard }

/// Whatever the row lengths, the kernel has only the variants that it lists.
#[test]
fn rows_of_every_length_share_a_few_pipelines() {
    let shared = common::device();
    let device = shared.with_limits(*shared.limits());
    let mut stream = device.stream().unwrap();
    let mut adam = Adam::new(&device).unwrap();
    let mut recorder = stream.record().unwrap();
    // One row, several rows, and no visibility.
    for (row, rows) in (1..=100).flat_map(|row| [(row, Some(1)), (row, Some(2)), (row, None)]) {
        let count = row * rows.unwrap_or(1);
        let gradients = device.upload("gradients", &vec![1.0f32; count]).unwrap();
        let visible = device.upload("visible", &vec![1u32; rows.unwrap_or(0)]).unwrap();
        let mut arrays: Vec<_> = (0..3)
            .map(|_| device.upload("parameters and moments", &vec![0.0f32; count]).unwrap())
            .collect();
        let [parameters, first, second] = &mut arrays[..] else { unreachable!("three") };
        let args = AdamArgs {
            gradients: gradients.view(),
            parameters: parameters.view_mut(),
            first: first.view_mut(),
            second: second.view_mut(),
            visible: rows.map(|_| (row, visible.view())),
        };
        let settings = AdamSettings { step: 1, ..AdamSettings::default() };
        adam.record(&mut recorder, &settings, args).unwrap();
    }
    stream.submit(recorder).unwrap();
    drop(stream);
    // Pipelines: without visibility, one row, six specialised lengths, and other lengths, short or long.
    assert_eq!(device.pipelines(), 10);
    common::assert_valid(&device);
}
