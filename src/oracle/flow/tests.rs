//! Tests of the whole oracle on flows that are known.

use super::*;
use std::path::PathBuf;

fn kitti() -> Option<(image::RgbImage, image::RgbImage, Vec<Option<[f32; 2]>>)> {
    let root = std::env::var_os("SPLAT4D_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let dir = root.join("flow_gt/KITTI");
    let gt = image::open(dir.join("flow_gt.png")).ok()?.to_rgb16();
    let a = image::open(dir.join("frame1.png")).ok()?.to_rgb8();
    let b = image::open(dir.join("frame2.png")).ok()?.to_rgb8();
    let gt = gt
        .pixels()
        .map(|p| (p.0[2] > 0).then(|| [p.0[0], p.0[1]].map(|c| (f32::from(c) - 32768.0) / 64.0)))
        .collect();
    Some((a, b, gt))
}

fn pixels(image: &image::RgbImage) -> Vec<f32> {
    image.as_raw().iter().map(|v| f32::from(*v) / 255.0).collect()
}

fn endpoint(
    flow: &[[f32; 2]],
    truth: &[Option<[f32; 2]>],
    keep: impl Fn(usize) -> bool,
) -> (f32, f32, usize) {
    let (mut sum, mut bad, mut n) = (0.0f64, 0, 0);
    for (i, (f, t)) in flow.iter().zip(truth).enumerate() {
        if let Some(t) = t
            && keep(i)
        {
            let e = (f[0] - t[0]).hypot(f[1] - t[1]);
            sum += f64::from(e);
            bad += usize::from(e > 3.0 && e > 0.05 * t[0].hypot(t[1]));
            n += 1;
        }
    }
    ((sum / n as f64) as f32, bad as f32 / n as f32 * 100.0, n)
}

fn env(name: &str, value: &mut f32) {
    if let Ok(v) = std::env::var(name) {
        *value = v.parse().unwrap();
    }
}
fn envu(name: &str, value: &mut u32) {
    if let Ok(v) = std::env::var(name) {
        *value = v.parse().unwrap();
    }
}

#[test]
#[ignore]
fn tune() {
    let Some((a, b, truth)) = kitti() else { panic!() };
    let mut s = FlowSettings::default();
    envu("COARSEST", &mut s.coarsest_side);
    envu("RADIUS", &mut s.start_radius);
    envu("STEPS", &mut s.search_steps);
    envu("PROP", &mut s.propagations);
    envu("WARPS", &mut s.warps);
    envu("SWEEPS", &mut s.sweeps);
    env("OMEGA", &mut s.relaxation);
    env("BRIGHT", &mut s.brightness);
    env("GRAD", &mut s.gradient);
    env("SMOOTH", &mut s.smoothness);
    env("EDGE", &mut s.edge);
    env("NOISE", &mut s.noise);
    env("KINK", &mut s.kink);
    let (w, h) = (a.width() as usize, a.height() as usize);
    let start = std::time::Instant::now();
    let pa = Pyramid::new(&pixels(&a), w, h, 3, s.coarsest_side);
    let pb = Pyramid::new(&pixels(&b), w, h, 3, s.coarsest_side);
    let t0 = start.elapsed();
    let pair = flow(&pa, &pb, None, &s);
    let t1 = start.elapsed();
    let all = endpoint(&pair.forward, &truth, |_| true);
    let inside = |i: usize| {
        let t = truth[i].unwrap();
        let (x, y) = ((i % w) as f32 + t[0], (i / w) as f32 + t[1]);
        x >= 0.0 && y >= 0.0 && x <= (w - 1) as f32 && y <= (h - 1) as f32
    };
    let noc = endpoint(&pair.forward, &truth, inside);
    let sure = endpoint(&pair.forward, &truth, |i| pair.forward_confidence[i] > 0.5);
    println!(
        "EPE all {:.3} ({:.2}%)  inside {:.3} ({:.2}%)  sure {:.3} ({:.2}%) of {:.1}%  {:?} {:?}",
        all.0,
        all.1,
        noc.0,
        noc.1,
        sure.0,
        sure.1,
        sure.2 as f32 / all.2 as f32 * 100.0,
        t0,
        t1
    );
    let car = |i: usize| (170..390).contains(&(i % w)) && (172..310).contains(&(i / w));
    let bg = endpoint(&pair.forward, &truth, |i| !car(i));
    let fg = endpoint(&pair.forward, &truth, car);
    println!("EPE bg {:.3} ({:.2}%) {}  car {:.3} ({:.2}%) {}", bg.0, bg.1, bg.2, fg.0, fg.1, fg.2);
    if let Ok(path) = std::env::var("DUMP") {
        let colour = |f: &[f32; 2]| {
            let m = (f[0].hypot(f[1]) / 100.0).sqrt().min(1.0);
            let t = f[1].atan2(f[0]);
            let c = |o: f32| ((0.5 + 0.5 * (t + o).cos()) * m * 255.0) as u8;
            image::Rgb([c(0.0), c(2.094), c(4.189)])
        };
        let img = image::RgbImage::from_fn(w as u32, h as u32 * 4, |x, y| {
            let i = (y as usize % h) * w + x as usize;
            match y as usize / h {
                0 => colour(&pair.forward[i]),
                1 => truth[i].as_ref().map_or(image::Rgb([0; 3]), colour),
                2 => {
                    let c = (pair.forward_confidence[i] * 255.0) as u8;
                    image::Rgb([c; 3])
                }
                _ => truth[i].map_or(image::Rgb([0; 3]), |t| {
                    let e = (pair.forward[i][0] - t[0]).hypot(pair.forward[i][1] - t[1]);
                    image::Rgb([(e * 25.0).min(255.0) as u8, 40, 255 - (e * 25.0).min(255.0) as u8])
                }),
            }
        });
        img.save(path).unwrap();
    }
}
