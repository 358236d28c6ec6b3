//! Writes `include/splat4d.h` from `src/capi`, and checks that the committed header matches the source.
//!
//! `cargo run --release -p header -- build | check`, in the repository's root.

use cbindgen::{Builder, Config, DocumentationStyle, ExportConfig, Language, Style};
use std::fs;
use std::process::ExitCode;

const HEADER: &str = "include/splat4d.h";

/// Source files, in the order of the header.
const SOURCES: [&str; 10] = [
    "version", "call", "vulkan", "device", "memory", "record", "scene", "renderer", "trainer",
    "ops",
];

/// Types that Vulkan's headers declare, or the preamble in their place.
const VULKANS: [&str; 8] = [
    "VkInstance",
    "VkPhysicalDevice",
    "VkDevice",
    "VkQueue",
    "VkCommandBuffer",
    "VkBuffer",
    "VkSemaphore",
    "PFN_vkGetInstanceProcAddr",
];

fn main() -> ExitCode {
    let result = match std::env::args().nth(1).as_deref() {
        Some("build") => header().and_then(|text| {
            fs::create_dir_all("include").map_err(|e| e.to_string())?;
            fs::write(HEADER, text).map_err(|e| format!("{HEADER}: {e}"))?;
            Ok(format!("{HEADER} written"))
        }),
        Some("check") => header().and_then(|text| match fs::read_to_string(HEADER) {
            Ok(committed) if committed == text => Ok(format!("{HEADER} matches src/capi")),
            _ => Err(format!(
                "{HEADER} does not match src/capi; run `cargo run --release -p header -- build`"
            )),
        }),
        _ => Err("usage: header build | header check   (in the repository's root)".into()),
    };
    match result {
        Ok(message) => {
            println!("{message}");
            ExitCode::SUCCESS
        }
        Err(message) => {
            eprintln!("{message}");
            ExitCode::FAILURE
        }
    }
}

fn header() -> Result<String, String> {
    let config = Config {
        language: Language::C,
        header: Some(include_str!("../preamble.h").trim_end().into()),
        include_guard: Some("SPLAT4D_H".into()),
        no_includes: true,
        sys_includes: vec!["stddef.h".into(), "stdint.h".into()],
        cpp_compat: true,
        style: Style::Both,
        usize_is_size_t: true,
        documentation_style: DocumentationStyle::C99,
        line_length: 100,
        tab_width: 4,
        export: ExportConfig {
            exclude: VULKANS.map(String::from).into(),
            ..ExportConfig::default()
        },
        after_includes: Some(include_str!("../vulkan.h").trim_end().into()),
        ..Config::default()
    };
    for entry in fs::read_dir("src/capi").map_err(|e| format!("src/capi: {e}"))? {
        let path = entry.map_err(|e| format!("src/capi: {e}"))?.path();
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        if name != "mod" && !SOURCES.contains(&&*name) {
            return Err(format!("{}: say in {} where it goes", path.display(), file!()));
        }
    }
    let mut builder = Builder::new().with_config(config);
    for name in SOURCES {
        builder = builder.with_src(format!("src/capi/{name}.rs"));
    }
    let mut text = Vec::new();
    builder.generate().map_err(|e| e.to_string())?.write(&mut text);
    String::from_utf8(text).map_err(|e| e.to_string())
}
