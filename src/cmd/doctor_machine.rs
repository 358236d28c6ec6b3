//! What `splat4d doctor` finds out about the program, the machine and other programs; no Vulkan.

use std::env;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::{Map, Value, json};
use splat4d::io::available_memory;
use splat4d::observe::onnx::{Runtime, RuntimeOptions};
use sysinfo::{CpuRefreshKind, MemoryRefreshKind, RefreshKind, System};

use super::common::{bytes, path_text, processors};
use super::doctor::Findings;

/// Below this, a note says that disk space is short: checkpoints and extracted frames of a longer clip.
const LITTLE_DISK: u64 = 2 << 30;
/// Below this, a note says that memory is short: a software driver and a short clip.
const LITTLE_MEMORY: u64 = 1 << 30;

/// Environment variables that change what the program, the Vulkan loader or a driver does.
const VARIABLES: [&str; 23] = [
    "VK_DRIVER_FILES",
    "VK_ADD_DRIVER_FILES",
    "VK_ICD_FILENAMES",
    "VK_LOADER_DRIVERS_SELECT",
    "VK_LOADER_DRIVERS_DISABLE",
    "VK_LOADER_DEBUG",
    "VK_LOADER_LAYERS_ENABLE",
    "VK_LOADER_LAYERS_DISABLE",
    "VK_INSTANCE_LAYERS",
    "VK_LAYER_PATH",
    "VK_ADD_LAYER_PATH",
    "MESA_VK_DEVICE_SELECT",
    "MESA_VK_VERSION_OVERRIDE",
    "LP_NUM_THREADS",
    "LP_NATIVE_VECTOR_WIDTH",
    "DRI_PRIME",
    "CUDA_VISIBLE_DEVICES",
    "ORT_DYLIB_PATH",
    "RAYON_NUM_THREADS",
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "XDG_CACHE_HOME",
    "TMPDIR",
];

/// The program's version and features.
pub fn program(findings: &mut Findings) -> Value {
    let features = [
        ("files", cfg!(feature = "files")),
        ("reconstruct", cfg!(feature = "reconstruct")),
        ("check", cfg!(feature = "check")),
        ("bench", cfg!(feature = "bench")),
        ("onnx", cfg!(feature = "onnx")),
        ("view", cfg!(feature = "view")),
        ("cli", cfg!(feature = "cli")),
        ("capi", cfg!(feature = "capi")),
    ];
    let features: Vec<_> = features.iter().filter(|(_, on)| *on).map(|(name, _)| *name).collect();
    let (version, debug) = (env!("CARGO_PKG_VERSION"), cfg!(debug_assertions));
    let text = format!("{version} (features {})", features.join(", "));
    match debug {
        true => findings.note(
            "splat4d",
            text + ", a debug build",
            "Build it with `cargo build --release`: what runs on the processor is slow now.",
        ),
        false => findings.ok("splat4d", text),
    }
    json!({ "version": version, "features": features, "debug": debug })
}

/// Operating system, processor and memory.
pub fn system(findings: &mut Findings) -> Value {
    let asked = RefreshKind::nothing()
        .with_cpu(CpuRefreshKind::nothing())
        .with_memory(MemoryRefreshKind::nothing().with_ram());
    let machine = System::new_with_specifics(asked);
    let version = System::long_os_version();
    let kernel = System::kernel_version();
    let brand = machine.cpus().first().map(|cpu| cpu.brand().trim().to_owned());
    let processor = brand.filter(|brand| !brand.is_empty());
    let (os, arch, cores) = (env::consts::OS, env::consts::ARCH, processors());
    let known = |value: &Option<String>| value.clone().unwrap_or("unknown".into());
    findings.ok(
        "system",
        format!(
            "{} ({os}, kernel {}), {arch}, {cores} cores, processor {}",
            known(&version),
            known(&kernel),
            known(&processor)
        ),
    );
    let memory = machine.total_memory();
    // The limits of control groups and of the process count too.
    let available = available_memory().unwrap_or_else(|| machine.available_memory());
    let text = format!("{}, of which this program can use {}", bytes(memory), bytes(available));
    match available < LITTLE_MEMORY {
        true => findings.note(
            "memory",
            text,
            "Close other programs, raise the limits (ulimit -v), or work on small frames (--size).",
        ),
        false => findings.ok("memory", text),
    }
    json!({
        "os": os,
        "version": version,
        "kernel": kernel,
        "arch": arch,
        "processor": processor,
        "cores": cores,
        "memory_bytes": memory,
        "available_bytes": available,
    })
}

/// The folders that are written to, with the free space.
pub fn folders(findings: &mut Findings) -> Value {
    // A name for the current folder that also serves where its path is not known.
    let current = env::current_dir().unwrap_or_else(|_| PathBuf::from("."));
    let folders = [
        ("current folder", current, "Change to another folder."),
        ("temporary folder", env::temp_dir(), "Name another one with TMPDIR."),
    ];
    let found = folders.map(|(what, path, remedy)| {
        let free = fs4::available_space(&path);
        let shown = format!("{:?}", path.to_string_lossy());
        match &free {
            Err(error) => findings.problem(what, format!("{shown}: {error}"), remedy),
            Ok(free) => {
                let text = format!("{shown}, {} free", bytes(*free));
                match tempfile::tempfile_in(&path) {
                    Err(error) => findings.note(
                        what,
                        format!("{text}; no file can be created in it: {error}"),
                        remedy,
                    ),
                    Ok(_) if *free < LITTLE_DISK => findings.note(
                        what,
                        text,
                        "Free some space: checkpoints and the frames of a video may not fit.",
                    ),
                    Ok(_) => findings.ok(what, text),
                }
            }
        }
        json!({ "use": what, "path": path_text(&path), "free_bytes": free.ok() })
    });
    json!(found)
}

/// The environment variables that are set.
pub fn environment(findings: &mut Findings) -> Value {
    let mut found = Map::new();
    for name in VARIABLES {
        let Some(value) = env::var_os(name) else { continue };
        let value = value.to_string_lossy().into_owned();
        // Quoted, so that no control character reaches the terminal.
        findings.note(
            "environment",
            format!("{name}={value:?}"),
            "Unset it if the report shows something that it could cause.",
        );
        found.insert(name.to_owned(), value.into());
    }
    if found.is_empty() {
        findings.ok("environment", "no variable that changes loader, drivers or threads is set");
    }
    found.into()
}

/// What a program prints on stdout; `None` if it is missing or fails.
fn printed(program: &str, arguments: &[&str]) -> Option<String> {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stderr(Stdio::null());
    let output = command.output().ok().filter(|output| output.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// The version that ffmpeg or ffprobe reports.
fn version(program: &str) -> Option<String> {
    let text = printed(program, &["-version"])?;
    let words = text.strip_prefix(program)?.strip_prefix(" version ")?;
    words.split_whitespace().next().map(str::to_owned)
}

/// ffmpeg and ffprobe, which read and write videos.
pub fn ffmpeg(findings: &mut Findings) -> Value {
    const INSTALL: &str = "Install ffmpeg (Debian, Ubuntu: apt-get install ffmpeg; Fedora: ffmpeg of RPM \
                           Fusion; Arch: pacman -S ffmpeg; macOS: brew install ffmpeg).";
    let (ffmpeg, ffprobe) = (version("ffmpeg"), version("ffprobe"));
    let h264 = ffmpeg.as_ref().map(|_| {
        printed("ffmpeg", &["-hide_banner", "-encoders"])
            .is_some_and(|list| list.split_whitespace().any(|word| word == "libx264"))
    });
    match (&ffmpeg, &ffprobe, h264) {
        (Some(ffmpeg), Some(_), Some(true)) => findings.ok("ffmpeg", ffmpeg.clone()),
        (Some(ffmpeg), Some(_), _) => findings.note(
            "ffmpeg",
            format!("{ffmpeg}, without libx264: videos can be read, but not written"),
            INSTALL,
        ),
        (Some(ffmpeg), None, _) => findings.note(
            "ffmpeg",
            format!("{ffmpeg}, but ffprobe was not found: videos can be written, but not read"),
            INSTALL,
        ),
        (None, ..) => findings.note(
            "ffmpeg",
            "not found: videos can be neither read nor written; folders of images can",
            INSTALL,
        ),
    }
    json!({ "version": ffmpeg, "ffprobe": ffprobe, "h264": h264 })
}

/// The ONNX Runtime, which networks need.
pub fn onnxruntime(findings: &mut Findings) -> Value {
    const SUBJECT: &str = "ONNX Runtime";
    match Runtime::load(&RuntimeOptions::default()) {
        Ok(runtime) => {
            let (library, build) = (runtime.library(), runtime.build());
            let release = release(library);
            let shown = release.as_deref().unwrap_or("of unknown version, 1.17 or later");
            findings.ok(SUBJECT, format!("{shown}, {:?} ({build})", library.to_string_lossy()));
            json!({
                "library": path_text(library), "version": release, "build": build, "error": null,
            })
        }
        Err(error) => {
            findings.note(
                SUBJECT,
                format!("{error}"),
                "It is optional: only --models and --lpips need it.",
            );
            json!({ "library": null, "version": null, "build": null, "error": error.to_string() })
        }
    }
}

/// The release in the name of a library's file: `1.22.0` of `libonnxruntime.so.1.22.0` and of
/// `libonnxruntime.1.22.0.dylib`. Links are followed.
fn release(library: &Path) -> Option<String> {
    let file = library.canonicalize().ok()?;
    let name = file.file_name()?.to_str()?;
    let number = name.trim_end_matches(".dylib").trim_start_matches("libonnxruntime.");
    let number = number.trim_start_matches("so.");
    let is_number = |part: &str| !part.is_empty() && part.bytes().all(|b| b.is_ascii_digit());
    (number.split('.').count() >= 2 && number.split('.').all(is_number)).then(|| number.to_owned())
}
