//! The loss on the device.

mod common;

use splat4d::ops::loss::{KnownDisparity, Loss, LossArgs, LossSettings, Reference};
use splat4d::ops::render::Render;
use splat4d::types::{Image, RenderSettings};

// Up to 400 workgroups, with a limit of 40 along an axis.
common::cases! { "loss", folded to 40:
    sizes, shares, weights, central_differences, flat_images, disparity,
}

#[test]
fn sizes_that_differ_are_named() {
    let device = common::device();
    let stream = &mut device.stream().unwrap();
    let settings = RenderSettings::default();
    let render = Render::plan(&device, 0, 0, 8, 4, settings).unwrap();
    let (pixels, mut gradients) =
        (render.pixels(&device).unwrap(), render.pixel_gradients(&device).unwrap());
    let op = Loss::plan(&device, 8, 4);
    let mut scratch = op.scratch(&device).unwrap();
    let mut error = |size: (u32, u32), known: usize| {
        let photo = Reference::new(&device, &Image::new(size.0, size.1, 3), None).unwrap();
        let known = KnownDisparity::new(&device, &vec![[1.0, 1.0]; known]).unwrap();
        op.record(
            &mut stream.record().unwrap(),
            &LossSettings::default(),
            LossArgs {
                rendered: &pixels,
                reference: &photo,
                disparity: Some(&known),
                gradients: &mut gradients,
            },
            &mut scratch,
        )
        .map_err(|error| error.to_string())
    };
    assert_eq!(error((8, 4), 32), Ok(()));
    assert_eq!(
        error((8, 5), 32).unwrap_err(),
        "loss: reference has 40 elements, expected 8×4 pixels"
    );
    assert_eq!(
        error((8, 4), 31).unwrap_err(),
        "loss: known disparities has 31 elements, expected at least 32"
    );
    let weights = Image::new(8, 3, 1);
    let error = Reference::new(&device, &Image::new(8, 4, 3), Some(&weights)).err().unwrap();
    assert_eq!(error.to_string(), "reference: weights has 24 elements, expected 32");
}
