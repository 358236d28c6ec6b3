use super::*;

fn accuracy(of_bound: f64) -> Accuracy {
    Accuracy { of_bound, error: of_bound * 1e-6, output: "image".into() }
}

fn spread(around: f64) -> Spread {
    Spread::new([0.99, 1.0, 1.01, 1.0, 0.995, 1.005].map(|s| s * around).to_vec()).unwrap()
}

fn row(id: &str, time: f64) -> Row {
    let work = Work { bytes: 1000, operations: 500 };
    let on = (Place::Device, Clock::Device);
    Row::timed(id, "1,000 keys", on, accuracy(0.5), work, spread(time))
}

/// A run whose strings try to escape from every format.
fn measured() -> Measurements {
    let machine = Machine {
        device: "<script>alert(1)</script> & \"card\"".into(),
        driver: "driver, with a comma\nand a line".into(),
        kind: "Software".into(),
        software: true,
        subgroup_size: 8,
        threads: 2,
    };
    let mut out = Measurements::new(machine, Some("0123abc".into()));
    out.unix_seconds = 1_000_000_000;
    out.peaks = Peaks { bytes: Some(2e9), operations: Some(1e9) };
    out.rows = vec![
        row("sort/pairs", 1000.0),
        Row::missed("scan/broken", "7", Place::Device, accuracy(f64::INFINITY)),
    ];
    let point = |knob: &str, value: &str, time: f64, max: f64| Point {
        ratio: Spread::new(vec![time / 4e6; 5]).unwrap(),
        knob: knob.into(),
        value: value.into(),
        settings: serde_json::json!({ "alpha_cut": 0.01 }),
        time: spread(time),
        error: ImageError { max, rmse: max / 10.0, psnr: 60.0 },
    };
    out.sweeps = vec![Sweep {
        scene: "a<b>.ply".into(),
        gaussians: 3,
        size: [480, 270],
        clock: Clock::Device,
        points: vec![
            point("", "best", 4e6, 0.0),
            point("α cut", "2/255", 3e6, 1e-3),
            point("α cut", "4/255", 3.5e6, 2e-3),
            point("T stop", "1e-2", 2e6, 5e-3),
        ],
    }];
    let at = |size: u64| CurvePoint {
        size,
        time: Some(spread(size as f64 * 1e3)),
        foreseen: Some(1000 * size),
        taken: Some(1010 * size),
        left_out: None,
        kernels: vec![("sort/count".into(), (size * size) as f64), ("scan/<b>".into(), 1.0)],
    };
    let missing = CurvePoint {
        time: None,
        foreseen: None,
        taken: None,
        left_out: Some("does not fit: <i>sh3".into()),
        kernels: Vec::new(),
        ..at(100_000)
    };
    out.curves = vec![Curve {
        pipeline: "render".into(),
        axis: "Gaussians".into(),
        held: "480×270 & more".into(),
        clock: Clock::Device,
        accuracy: accuracy(0.5),
        points: vec![at(100), at(1000), at(10_000), missing],
    }];
    out
}

#[test]
fn a_law_goes_through_its_points() {
    let squares: Vec<(u64, f64)> = (1..6).map(|n| (n, 3.0 * (n * n) as f64)).collect();
    let law = PowerLaw::fit(&squares).unwrap();
    assert!((law.exponent - 2.0).abs() < 1e-12 && (law.factor - 3.0).abs() < 1e-9, "{law:?}");
    assert!(law.off < 1.0 + 1e-9 && law.range == [1, 5], "{law:?}");
    assert!((law.at(10.0) - 300.0).abs() < 1e-6);
    let bent = PowerLaw::fit(&[(1, 1.0), (10, 20.0), (100, 100.0)]).unwrap();
    assert!((bent.exponent - 1.0).abs() < 1e-12 && bent.off > 1.5, "{bent:?}");
    assert_eq!(PowerLaw::fit(&[]), None);
    assert_eq!(PowerLaw::fit(&[(7, 1.0)]), None, "one size tells nothing");
    assert_eq!(PowerLaw::fit(&[(7, 1.0), (8, 0.0)]), None, "no logarithm");
}

#[test]
fn a_curve_names_what_grows_too_fast() {
    let curve = &measured().curves[0];
    let law = curve.time_law().unwrap();
    assert!((law.exponent - 1.0).abs() < 1e-9 && law.range == [100, 10_000], "{law:?}");
    assert_eq!(curve.bytes()[0], (100, 101_000.0), "taken, where it was");
    let steep = curve.steeper_than(1.1);
    assert_eq!(steep.len(), 1, "{steep:?}");
    assert!(steep[0].0 == "sort/count" && (steep[0].1 - 2.0).abs() < 1e-9, "{steep:?}");
}

#[test]
fn a_row_that_missed_its_bound_has_no_speed() {
    let missed = Row::timed(
        "sort/pairs",
        "7",
        (Place::Device, Clock::Device),
        accuracy(1.01),
        Work { bytes: 8, operations: 8 },
        spread(10.0),
    );
    assert_eq!(missed.time(), None);
    assert_eq!((missed.bandwidth(), missed.throughput()), (None, None));
    assert_eq!(missed.share(&Peaks { bytes: Some(1.0), operations: Some(1.0) }), None);
    // Nor does one that a file declares.
    let mut json = serde_json::to_value(row("x", 5.0)).unwrap();
    json["accuracy"]["of_bound"] = serde_json::json!(2.0);
    let read: Row = serde_json::from_value(json).unwrap();
    assert_eq!(read.time(), None);
}

#[test]
fn rates_are_work_over_the_median() {
    let row = row("x", 1000.0);
    assert_eq!(row.bandwidth(), Some(1e9));
    assert_eq!(row.throughput(), Some(0.5e9));
    let peaks = Peaks { bytes: Some(2e9), operations: Some(4e9) };
    assert_eq!(row.share(&peaks), Some(0.5));
}

#[test]
fn json_comes_back_as_it_went() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deep/bench.json");
    let measured = measured();
    measured.save(&path).unwrap();
    assert_eq!(Measurements::open(&path).unwrap(), measured);
    std::fs::write(&path, r#"{"format": 99}"#).unwrap();
    let message = Measurements::open(&path).unwrap_err().to_string();
    assert!(message.contains("`format` is 99"), "{message}");
    std::fs::write(&path, r#"{"format": 2}"#).unwrap();
    let message = Measurements::open(&path).unwrap_err().to_string();
    assert!(message.contains("missing field"), "{message}");
}

/// Fields of one line of CSV.
fn fields(text: &str) -> Vec<Vec<String>> {
    let (mut lines, mut line, mut field, mut quoted) =
        (Vec::new(), Vec::new(), String::new(), false);
    let mut chars = text.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            '"' if quoted && chars.peek() == Some(&'"') => {
                chars.next();
                field.push('"');
            }
            '"' => quoted = !quoted,
            ',' if !quoted => line.push(std::mem::take(&mut field)),
            '\r' if !quoted => {}
            '\n' if !quoted => {
                line.push(std::mem::take(&mut field));
                lines.push(std::mem::take(&mut line));
            }
            c => field.push(c),
        }
    }
    assert!(!quoted && line.is_empty(), "a table ends with a line");
    lines
}

#[test]
fn csv_has_every_row_and_point() {
    let measured = measured();
    let lines = fields(&csv(&measured));
    assert_eq!(lines.len(), 1 + 2 + 4 + 4);
    assert!(lines.iter().all(|line| line.len() == lines[0].len()), "{lines:#?}");
    let column = |name: &str| lines[0].iter().position(|h| h == name).unwrap();
    assert_eq!(lines[1][column("driver")], measured.machine.driver);
    assert_eq!(lines[1][column("median_ns")], "1000");
    assert_eq!(lines[2][column("median_ns")], "", "no speed without accuracy");
    assert_eq!(lines[2][column("error_of_bound")], "inf");
    assert_eq!(lines[4][column("id")], "α cut");
}

#[test]
fn the_page_escapes_everything_and_needs_nothing() {
    let page = page(&measured()).unwrap();
    assert!(!page.contains("<script"), "a name became markup");
    assert!(page.contains("&lt;script&gt;alert(1)&lt;/script&gt; &amp; &quot;card&quot;"));
    assert!(page.contains("a&lt;b&gt;.ply"));
    assert!(page.contains("software driver") && page.contains("0123abc"));
    assert!(page.contains("no speed") && page.contains("2001-09-09T01:46:40Z"));
    assert_eq!(page.matches("<svg").count(), 4);
    assert!(page.contains("does not fit: &lt;i&gt;sh3") && page.contains("size^1.00"));
    for source in ["src=", "@import", "url(", "href=\"http"] {
        assert!(!page.contains(source), "{source}");
    }
    assert_well_formed(&page);
}

/// Asserts that all elements are closed in order.
fn assert_well_formed(page: &str) {
    let mut open: Vec<&str> = Vec::new();
    let mut rest = page;
    while let Some(at) = rest.find('<') {
        let end = rest[at..].find('>').expect("a tag ends") + at;
        let tag = &rest[at + 1..end];
        rest = &rest[end + 1..];
        let name = tag.trim_start_matches('/').split([' ', '\n', '/']).next().unwrap();
        if tag.starts_with('!') || tag.starts_with('?') || tag.ends_with('/') {
            continue;
        }
        if ["meta", "link"].contains(&name) {
            continue;
        }
        match tag.starts_with('/') {
            false => open.push(name),
            true => assert_eq!(open.pop(), Some(name), "…{}", &rest[..rest.len().min(80)]),
        }
    }
    assert!(open.is_empty(), "{open:?}");
}

#[test]
fn the_front_holds_what_no_other_beats() {
    let sweep = &measured().sweeps[0];
    assert_eq!(sweep.front(|e| e.max), [3, 1, 0]);
}

fn run(samples: &[f64]) -> Measurements {
    let mut out = Measurements::new(Machine::default(), None);
    let time = Spread::new(samples.to_vec()).unwrap();
    let on = (Place::Device, Clock::Device);
    out.rows = vec![Row::timed("x", "1", on, accuracy(0.1), Work::default(), time)];
    out
}

#[test]
fn verdicts_follow_the_noise() {
    let steady = [100.0, 101.0, 99.0, 100.5, 99.5, 100.2, 99.8];
    let doubled = steady.map(|s| 2.0 * s);
    let wild = [60.0, 150.0, 95.0, 240.0, 70.0, 130.0, 110.0];
    let judged = |a: &[f64], b: &[f64]| compare(&run(a), &run(b)).remove(0);
    let slower = judged(&steady, &doubled);
    assert_eq!(slower.verdict, Verdict::Slower);
    assert_eq!(slower.ratio, Some(2.0));
    let [low, high] = slower.interval.unwrap();
    assert!((1.9..=2.0).contains(&low) && (2.0..2.1).contains(&high), "{low} {high}");
    assert_eq!(judged(&doubled, &steady).verdict, Verdict::Faster);
    assert_eq!(judged(&steady, &steady).verdict, Verdict::Noise);
    assert_eq!(judged(&steady, &wild).verdict, Verdict::Noise, "the spread forbids it");
    assert_eq!(judged(&steady[..4], &doubled[..4]).verdict, Verdict::Noise, "too few samples");
    assert_eq!(judged(&steady, &wild), judged(&steady, &wild), "repeatable");
}

#[test]
fn rows_without_a_partner_are_named() {
    let (mut a, mut b) = (run(&[1.0; 9]), run(&[1.0; 9]));
    a.rows.push(row("gone", 1.0));
    b.rows.push(row("new", 1.0));
    b.rows.push(Row::missed("x", "2", Place::Device, accuracy(3.0)));
    let all = compare(&a, &b);
    let lone: Vec<&str> = all
        .iter()
        .filter(|c| c.verdict == Verdict::Incomparable)
        .map(|c| c.name.as_str())
        .collect();
    assert_eq!(lone, ["gone, 1,000 keys", "new, 1,000 keys", "x, 2"]);
}
