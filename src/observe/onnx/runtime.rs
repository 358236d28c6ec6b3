//! The ONNX Runtime: its library, found and loaded when a network is asked for.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;

use ort::ep;
use ort::session::Session;

use crate::{Error, Result, io};

/// What networks run on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Provider {
    /// The processor.
    #[default]
    Cpu,
    /// NVIDIA's GPUs.
    Cuda,
    /// AMD's GPUs.
    Rocm,
    /// Apple's devices.
    CoreMl,
    /// Windows' GPUs.
    DirectMl,
    /// Intel's devices.
    OpenVino,
}

/// How the runtime is to be found and used.
#[derive(Clone, Debug, Default)]
pub struct RuntimeOptions {
    /// The library's file. Without it, that of the environment variable `ORT_DYLIB_PATH`, else that of the
    /// `onnxruntime` package of the Python on the path, else the system's.
    pub library: Option<PathBuf>,
    /// What networks run on.
    pub provider: Provider,
    /// Threads of one network; 0: as many as the runtime thinks best.
    pub threads: usize,
}

/// The loaded runtime. There is one in a process.
#[derive(Clone, Debug)]
pub struct Runtime {
    library: PathBuf,
    provider: Provider,
    threads: usize,
}

/// The library that this process has loaded.
static LOADED: Mutex<Option<PathBuf>> = Mutex::new(None);

/// What to do where there is none.
const INSTALL: &str = "install it (pip install onnxruntime), or name its library: libonnxruntime.so, \
                       libonnxruntime.dylib or onnxruntime.dll, of version 1.17 or later";

impl Runtime {
    /// Finds and loads the library. Later calls must lead to the same one.
    ///
    /// # Errors
    /// No library, one that does not load (of another machine, say) or that is too old, a second one
    /// beside that of an earlier call.
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

    /// The library's file, as it was found.
    pub fn library(&self) -> &Path {
        &self.library
    }

    /// Opens a network's file.
    pub(super) fn session(&self, file: &Path) -> Result<Session> {
        // The runtime's own message for a missing file says less.
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

/// The library that the environment, Python or the system names.
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
