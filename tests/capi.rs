//! The C interface as hosts use it: installed by the script, found by pkg-config, compiled by the
//! system's compilers without warnings, and run on the software driver. The programs are in `tests/c`;
//! the Rust side computes their expected results, which must match bit for bit.

mod host;

use host::{camera, gaussians};
use splat4d::gpu::{Device, Request};
use splat4d::renderer::Renderer;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::train::own_loss::OwnGradients;
use splat4d::train::{SceneOptimiser, TrainSettings, Trainer, TrainingView};
use splat4d::types::{Gaussians, Image};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

const WARNINGS: [&str; 4] = ["-Wall", "-Wextra", "-Werror", "-pedantic"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A path for the tests' output, beside cargo's.
fn made(name: &str) -> PathBuf {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("the target directory");
    let path = target.join("c/tests").join(name);
    std::fs::create_dir_all(&path).unwrap();
    path
}

#[track_caller]
fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| {
        panic!("{:?}: {error}; tools/setup.sh test installs it", command.get_program())
    });
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {}\n{text}\n{errors}", output.status);
    text
}

/// The installation prefix with both libraries, the header and the pkg-config file.
fn prefix() -> &'static Path {
    static PREFIX: OnceLock<PathBuf> = OnceLock::new();
    PREFIX.get_or_init(|| {
        let prefix = made("prefix");
        let target = prefix.ancestors().nth(3).expect("the target directory");
        let script = root().join("tools/install-c.sh");
        run(Command::new(script).arg(&prefix).env("CARGO_TARGET_DIR", target));
        prefix
    })
}

/// The output of pkg-config.
fn flags(which: &[&str]) -> Vec<String> {
    let from = prefix().join("lib/pkgconfig");
    let mut command = Command::new("pkg-config");
    let text = run(command.args(which).arg("splat4d").env("PKG_CONFIG_PATH", from));
    text.split_whitespace().map(str::to_owned).collect()
}

/// Compiles a program against the shared library, with additional flags.
fn compile(compiler: &str, source: &Path, name: &str, others: &[&str]) -> PathBuf {
    let program = made("bin").join(name);
    let mut command = Command::new(compiler);
    command.args(WARNINGS).args(["-O1", "-g"]).args(flags(&["--cflags"])).arg(source);
    command.arg("-o").arg(&program).args(flags(&["--libs"])).args(others);
    let rpath = format!("-Wl,-rpath,{}", prefix().join("lib").display());
    run(command.arg(rpath));
    program
}

fn source(name: &str) -> PathBuf {
    root().join("tests/c").join(name)
}

/// The size of a test: small under tools that slow it down.
#[derive(Clone, Copy)]
struct Size {
    width: u32,
    height: u32,
    count: usize,
}

const LARGE: Size = Size { width: 80, height: 56, count: 200 };
const SMALL: Size = Size { width: 16, height: 16, count: 5 };

/// Writes the programs' expected results into a folder.
fn expected(name: &str, size: Size) -> [String; 4] {
    let folder = made(name);
    let Size { width, height, count } = size;
    let device = Device::open(&Request::software()).unwrap();
    let (camera, start) = (camera(width, height), gaussians(count));
    let cameras = vec![SceneCamera { time: 0.5, camera }];
    let scene = Scene { cameras, ..Scene::of(start.clone()) };
    scene.save(folder.join("scene.safetensors")).unwrap();
    let write = |name: &str, parts: &[&[f32]]| {
        let bytes: Vec<u8> = parts.concat().iter().flat_map(|value| value.to_le_bytes()).collect();
        std::fs::write(folder.join(name), bytes).unwrap();
    };
    let picture = Renderer::new(&device, &scene).unwrap().render(&camera, 0.0).unwrap();
    write("picture.f32", &[&picture.rgba.pixels, &picture.depth.pixels]);
    write("start.f32", &floats(&start));

    let settings = TrainSettings {
        steps: 100,
        growth: None,
        max_gaussians: count,
        sh_degree: 0,
        sh_interval: 0,
        ..TrainSettings::default()
    };
    let mut image = Image::new(width, height, 3);
    for (i, value) in image.pixels.iter_mut().enumerate() {
        *value = 0.5 + 0.4 * (i as f32 * 0.07).sin();
    }
    write("target.f32", &[&image.pixels]);
    let (weights, disparity, mask) = (None, None, None);
    let view = TrainingView { camera, time: 0.0, image, weights, disparity, mask, every: 1 };
    let mut trainer = Trainer::new(&device, &[view], &start, None, settings.clone()).unwrap();
    (0..5).for_each(|_| trainer.step().unwrap());
    write("trained.f32", &floats(&trainer.gaussians().unwrap()));

    let mut stream = device.stream().unwrap();
    let mut trainer = SceneOptimiser::new(&device, &start, None, 1.0, settings).unwrap();
    let ones = device.upload("ones", &vec![[1.0f32; 4]; (width * height) as usize]).unwrap();
    let mut recorder = stream.record().unwrap();
    let pass = trainer.forward(&mut recorder, &camera, 0.0).unwrap();
    let by = OwnGradients { rgba: ones.view(), depth: None };
    let pass = trainer.backward(&mut recorder, pass, by).unwrap();
    stream.submit(recorder).unwrap();
    let found = trainer.gradients(&pass).unwrap();
    let pose = stream.download(found.pose).unwrap();
    let g = found.gaussians;
    let [positions, log_scales, opacity_logits, sh] =
        [&g.positions, &g.log_scales, &g.opacity_logits, &g.sh[0]]
            .map(|buffer| stream.download(buffer).unwrap());
    let rotations = stream.download(&g.rotations).unwrap();
    assert!(positions.iter().any(|&value| value != 0.0));
    let parts =
        [&positions[..], &log_scales, rotations.as_flattened(), &opacity_logits, &sh, &pose];
    write("gradients.f32", &parts);
    let folder = folder.into_os_string().into_string().expect("UTF-8");
    [folder, width.to_string(), height.to_string(), count.to_string()]
}

fn floats(g: &Gaussians) -> [&[f32]; 5] {
    [
        g.positions.as_flattened(),
        g.log_scales.as_flattened(),
        g.rotations.as_flattened(),
        &g.opacity_logits,
        g.sh.as_flattened(),
    ]
}

#[test]
fn the_header_is_c_and_cpp_beside_vulkans_and_without() {
    let folder = made("header");
    for (compiler, standards, extension) in
        [("cc", ["c99", "c11"], "c"), ("c++", ["c++11", "c++20"], "cpp")]
    {
        for standard in standards {
            for before in ["", "#define VK_NO_PROTOTYPES\n#include <vulkan/vulkan.h>\n"] {
                let path = folder.join(format!("alone.{extension}"));
                let text =
                    format!("{before}#include \"splat4d.h\"\nint main(void) {{ return 0; }}\n");
                std::fs::write(&path, text).unwrap();
                let mut command = Command::new(compiler);
                command.args(WARNINGS).arg(format!("-std={standard}")).arg("-fsyntax-only");
                run(command.arg("-I").arg(root().join("include")).arg(&path));
            }
        }
    }
}

#[test]
fn the_readmes_program_draws() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let (_, rest) = readme.split_once("```c\n").expect("README.md has a block of C");
    let (program, _) = rest.split_once("```").expect("and it ends");
    let folder = made("readme");
    std::fs::write(folder.join("ball.c"), program).unwrap();
    let program = compile("cc", &folder.join("ball.c"), "ball", &["-std=c99", "-lm"]);
    run(Command::new(program).current_dir(&folder));
    let picture = std::fs::read(folder.join("ball.ppm")).unwrap();
    assert_eq!(picture.len(), "P6 400 300 255\n".len() + 3 * 400 * 300);
    let body = &picture[15..];
    // The background is white, and the ball is coloured.
    assert_eq!(body[..3], [255; 3]);
    assert!(body.chunks(3).filter(|pixel| pixel.iter().any(|&v| v < 200)).count() > 10_000);
}

/// The programs of `tests/c`: compiler, file, standard.
const PROGRAMS: [[&str; 3]; 4] = [
    ["cc", "engine.c", "-std=c99"],
    ["cc", "bad.c", "-std=c99"],
    ["cc", "host.c", "-std=c99"],
    ["c++", "host.cpp", "-std=c++17"],
];

/// Compiles all programs with additional flags.
fn programs(name: &str, others: &[&str]) -> Vec<PathBuf> {
    let flags = |standard| [&[standard, "-ldl", "-pthread"], others].concat();
    PROGRAMS
        .iter()
        .map(|[compiler, file, standard]| {
            compile(compiler, &source(file), &format!("{file}-{name}"), &flags(standard))
        })
        .collect()
}

#[test]
fn programs_with_the_shared_library() {
    let arguments = expected("shared", LARGE);
    for program in programs("shared", &[]) {
        let mut command = Command::new(&program);
        let said = run(command.args(&arguments).env("SPLAT4D_VALIDATION", "1"));
        assert!(said.ends_with(": ok\n"), "{}: {said}", program.display());
    }
}

#[test]
fn a_c_program_with_the_static_library() {
    let arguments = expected("static", SMALL);
    let program = made("bin").join("engine.c-static");
    let mut command = Command::new("cc");
    command.args(WARNINGS).arg("-std=c99").args(flags(&["--cflags"])).arg(source("engine.c"));
    command.arg("-o").arg(&program).arg(prefix().join("lib/libsplat4d.a"));
    let private = flags(&["--static", "--libs"]);
    run(command.args(private.iter().filter(|flag| *flag != "-lsplat4d")));
    assert_eq!(run(Command::new(program).args(&arguments)), "engine: ok\n");
}

#[test]
fn address_sanitizer_finds_nothing() {
    let keep = source("keep.c").into_os_string().into_string().expect("UTF-8");
    let sanitize = ["-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", &keep];
    let arguments = expected("sanitized", SMALL);
    for program in programs("sanitized", &sanitize) {
        let mut command = Command::new(program);
        command.args(&arguments).env_remove("SPLAT4D_VALIDATION");
        run(command.env("ASAN_OPTIONS", "detect_leaks=1"));
    }
}

#[test]
fn valgrind_finds_nothing() {
    let arguments = expected("valgrind", SMALL);
    let suppressions = format!("--suppressions={}", source("valgrind.supp").display());
    for program in programs("valgrind", &[]) {
        let mut command = Command::new("valgrind");
        command.args(["--error-exitcode=9", "--leak-check=full", "--show-leak-kinds=definite"]);
        command.args(["--errors-for-leak-kinds=definite", "--gen-suppressions=all", "--quiet"]);
        command.arg(&suppressions).arg(program).args(&arguments);
        run(command.env_remove("SPLAT4D_VALIDATION"));
    }
}
