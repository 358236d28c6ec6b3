//! Benchmarks of the CPU reference, for comparison with the rows on the device.

use super::job::{Entry, Job};
use super::rows::thousands;
use super::scenes::{camera, cloud, rng};
use super::verify::Check;
use crate::oracle::raster::Pixels;
use crate::oracle::view::{Cloud, View};
use crate::oracle::{render, sort};
use crate::report::{Place, Work};
use crate::types::RenderSettings;
use rand::RngExt;
use std::cell::RefCell;
use std::rc::Rc;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    let counts: &[usize] = if quick { &[1 << 14] } else { &[1 << 14, 1 << 17, 1 << 20] };
    for &n in counts {
        let size = format!("{} pairs", thousands(n));
        let radix = |pairs: &mut [(u32, u32)]| radsort::sort_by_key(pairs, |pair| pair.0);
        all.push(Entry::new("sort/radsort", size.clone(), move |_, s| Ok(sorted(s, n, radix))));
        let unstable = |pairs: &mut [(u32, u32)]| pairs.sort_unstable_by_key(|pair| pair.0);
        all.push(Entry::new("sort/sort_unstable", size, move |_, s| Ok(sorted(s, n, unstable))));
    }
    let scenes: &[(usize, u32, u32)] =
        if quick { &[(4000, 240, 136)] } else { &[(10_000, 480, 270), (50_000, 960, 540)] };
    for &(n, w, h) in scenes {
        let size = format!("{} Gaussians, {w}×{h}", thousands(n));
        let job = move |_: &crate::gpu::Device, seed: u64| Ok(rendered(seed, n, w, h));
        all.push(Entry::new("render/oracle_f32", size, job));
    }
    all
}

fn sorted(seed: u64, n: usize, sort_pairs: fn(&mut [(u32, u32)])) -> Job {
    let mut rng = rng(seed);
    let keys: Vec<u32> = (0..n).map(|_| rng.random()).collect();
    let pairs: Vec<(u32, u32)> = keys.iter().copied().zip(0..).collect();
    let mut once = pairs.clone();
    sort_pairs(&mut once);
    let payload: Vec<u32> = (0..n as u32).collect();
    let truth = sort::by_bits(&keys, &payload, 0..32).0;
    let mut check = Check::new();
    check.exact("keys", &once.iter().map(|pair| pair.0).collect::<Vec<_>>(), &truth);
    let state = Rc::new(RefCell::new(once));
    let again = state.clone();
    Job {
        accuracy: check.accuracy(),
        work: Work { bytes: 16 * n as u64, operations: n as u64 },
        place: Place::Processor,
        reset: Some(Box::new(move || {
            again.borrow_mut().copy_from_slice(&pairs);
            Ok(())
        })),
        execute: Box::new(move || {
            sort_pairs(&mut state.borrow_mut());
            Ok(None)
        }),
    }
}

/// The oracle in f32, over all threads.
fn rendered(seed: u64, n: usize, width: u32, height: u32) -> Job {
    let (settings, camera) = (RenderSettings::default(), camera(width, height));
    let scene = cloud(seed, n, 3, &camera);
    let truth = render::forward(&Cloud::<f64>::new(&scene), &View::new(&camera), &settings);
    let (single, view) = (Cloud::<f32>::new(&scene), View::<f32>::new(&camera));
    let image = rgba(&render::forward(&single, &view, &settings).pixels);
    let mut check = Check::new();
    super::rows::compare_image(&mut check, "image", &image, &truth.pixels);
    Job::on_processor(check.accuracy(), Work::default(), move || {
        std::hint::black_box(render::forward(&single, &view, &settings));
    })
}

fn rgba(pixels: &Pixels<f32>) -> Vec<[f32; 4]> {
    let all = pixels.rgb.iter().zip(&pixels.alpha);
    all.map(|(c, &alpha)| [c[0], c[1], c[2], alpha]).collect()
}
