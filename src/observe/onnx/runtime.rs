//! The ONNX Runtime library, which is found and loaded when a network is requested.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;

use ort::ep;
use ort::session::Session;

use crate::{Error, Result, io};

/// Execution provider of the networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Provider {
    /// The CPU.
    #[default]
    Cpu,
    /// NVIDIA GPUs.
    Cuda,
    /// AMD GPUs.
    Rocm,
    /// Apple devices.
    CoreMl,
    /// GPUs under Windows.
    DirectMl,
    /// Intel devices.
    OpenVino,
}

/// Options for finding and using the runtime.
#[derive(Clone, Debug, Default)]
pub struct RuntimeOptions {
    /// The library's file. Without it, the environment variable `ORT_DYLIB_PATH` is used, else the
    /// `onnxruntime` package of the Python on the path, else the system's library.
    pub library: Option<PathBuf>,
    /// Execution provider of the networks.
    pub provider: Provider,
    /// Threads per network; 0 leaves the number to the runtime.
    pub threads: usize,
}

/// The loaded runtime; one per process.
#[derive(Clone, Debug)]
pub struct Runtime {
    library: PathBuf,
    provider: Provider,
    threads: usize,
}

/// The library that this process has loaded.
static LOADED: Mutex<Option<PathBuf>> = Mutex::new(None);

/// Remedy in the message for a missing library.
const INSTALL: &str = "install it (pip install onnxruntime), or name its library: libonnxruntime.so, \
                       libonnxruntime.dylib or onnxruntime.dll, of version 1.17 or later";

impl Runtime {
    /// Finds and loads the library. Later calls must resolve to the same one.
    ///
    /// # Errors
    /// No library is found, it does not load (for example, because it is built for another platform) or is
    /// too old, or it differs from that of an earlier call.
    pub fn load(options: &RuntimeOptions) -> Result<Runtime> {
        let library = match &options.library {
            Some(library) => library.clone(),
            None => find(),
        };
        let mut loaded = LOADED.lock().unwrap_or_else(|broken| broken.into_inner());
        match loaded.as_ref() {
            None => load(&library)?,
            Some(other) if *other == library => {}
            Some(other) => {
                return Err(Error::Input(format!(
                    "the ONNX Runtime {} is loaded already; a process has one, {} cannot be loaded \
                     besides",
                    other.display(),
                    library.display()
                )));
            }
        }
        *loaded = Some(library.clone());
        Ok(Runtime { library, provider: options.provider, threads: options.threads })
    }

    /// The library's file as it was found.
    pub fn library(&self) -> &Path {
        &self.library
    }

    /// What the library says of its build: commit, type, options. The release is not part of it.
    pub fn build(&self) -> &'static str {
        ort::info()
    }

    /// Opens a network's file.
    pub(super) fn session(&self, file: &Path) -> Result<Session> {
        // The runtime's own message for a missing file is less informative.
        io::open(file)?;
        let failed =
            |what: String| Error::format(file, format!("the ONNX Runtime refuses it: {what}"));
        let mut builder = Session::builder().map_err(|error| failed(error.to_string()))?;
        if self.threads > 0 {
            builder = builder
                .with_intra_threads(self.threads)
                .map_err(|error| failed(error.to_string()))?;
        }
        let provider = match self.provider {
            Provider::Cpu => None,
            Provider::Cuda => Some(ep::CUDA::default().build()),
            Provider::Rocm => Some(ep::ROCm::default().build()),
            Provider::CoreMl => Some(ep::CoreML::default().build()),
            Provider::DirectMl => Some(ep::DirectML::default().build()),
            Provider::OpenVino => Some(ep::OpenVINO::default().build()),
        };
        if let Some(provider) = provider {
            let refused = |error: String| {
                Error::Input(format!(
                    "{:?} cannot be used with {}: {error}; take a library that was built with it, or the \
                     processor",
                    self.provider,
                    self.library.display()
                ))
            };
            builder = builder
                .with_execution_providers([provider.error_on_failure()])
                .map_err(|error| refused(error.to_string()))?;
        }
        builder.commit_from_file(file).map_err(|error| failed(error.to_string()))
    }
}

fn load(library: &Path) -> Result<()> {
    match ort::init_from(library) {
        Ok(environment) => {
            environment.with_name("splat4d").with_telemetry(false).commit();
            Ok(())
        }
        Err(error) => Err(Error::Input(format!("no ONNX Runtime: {error}; {INSTALL}"))),
    }
}

/// The library named by the environment, Python or the system.
fn find() -> PathBuf {
    let told = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty());
    told.map(PathBuf::from).or_else(of_python).unwrap_or_else(|| {
        let name = match std::env::consts::OS {
            "windows" => "onnxruntime.dll",
            "macos" => "libonnxruntime.dylib",
            _ => "libonnxruntime.so",
        };
        name.into()
    })
}

/// The library in the `onnxruntime` package of the Python on the path.
fn of_python() -> Option<PathBuf> {
    const WHERE: &str = "import importlib.util as u; s = u.find_spec('onnxruntime'); \
                         print(s.submodule_search_locations[0] if s else '')";
    let ask = |python: &str| {
        let asked = Command::new(python).args(["-c", WHERE]).stderr(Stdio::null()).output().ok()?;
        let folder = String::from_utf8(asked.stdout).ok()?;
        let folder = folder.trim();
        (asked.status.success() && !folder.is_empty()).then(|| Path::new(folder).join("capi"))
    };
    let folder = ["python3", "python"].into_iter().find_map(ask)?;
    let library = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("libonnxruntime.so")
            || name == "onnxruntime.dll"
            || (name.starts_with("libonnxruntime.") && name.ends_with(".dylib"))
    };
    let entries = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    entries.filter(library).min()
}
