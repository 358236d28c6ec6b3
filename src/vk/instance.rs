//! The Vulkan loader, the instance, the validation layer and the list of devices.

use super::requirements::Requirements;
use super::vk_error;
use crate::error::{Error, Result};
use ash::{ext, vk};
use std::ffi::{CStr, c_void};
use std::sync::{Arc, Mutex};

const NO_LOADER: &str = "no Vulkan loader found; install it and a driver (Debian, Ubuntu: apt-get \
     install libvulkan1 mesa-vulkan-drivers; Fedora: dnf install vulkan-loader mesa-vulkan-drivers; \
     Arch: pacman -S vulkan-icd-loader vulkan-swrast; each brings a software driver too)";
const A_DRIVER: &str = "install the driver of your GPU, or a software driver (Debian, Ubuntu: apt-get \
     install mesa-vulkan-drivers; Fedora: dnf install mesa-vulkan-drivers; Arch: pacman -S \
     vulkan-swrast), or point VK_DRIVER_FILES at one";
/// The environment variables that list driver files for the loader; the first that is set applies.
/// If none is set, the loader searches its own folders.
const DRIVER_LISTS: [&str; 2] = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"];

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// The messages of the validation layer.
pub(crate) type Messages = Mutex<Vec<String>>;

/// A Vulkan instance with its loader, destroyed after every device; or a host's instance.
pub(crate) struct Instance {
    // Declared first: the instance's functions lie in the library that `entry` keeps loaded.
    pub(super) raw: ash::Instance,
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    pub(super) messages: Arc<Messages>,
    /// `None` for a host's instance, which the host destroys.
    entry: Option<ash::Entry>,
}

impl Instance {
    pub(crate) fn new(validation: bool) -> Result<Instance> {
        let entry = load()?;
        let application = vk::ApplicationInfo::default()
            .application_name(c"splat4d")
            .engine_name(c"splat4d")
            .api_version(vk::API_VERSION_1_3);
        let messages = Arc::new(Messages::default());
        let mut info = vk::InstanceCreateInfo::default().application_info(&application);
        let layers = [VALIDATION_LAYER.as_ptr()];
        let extensions = [ext::debug_utils::NAME.as_ptr(), ext::validation_features::NAME.as_ptr()];
        let enabled = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
        let mut features =
            vk::ValidationFeaturesEXT::default().enabled_validation_features(&enabled);
        let mut early = messenger_info(&messages);
        if validation {
            require_layer(&entry)?;
            info = info
                .enabled_layer_names(&layers)
                .enabled_extension_names(&extensions)
                .push_next(&mut features)
                .push_next(&mut early);
        }
        // SAFETY: everything `info` points at outlives the call.
        let raw = unsafe { entry.create_instance(&info, None) }.map_err(|result| match result {
            vk::Result::ERROR_INCOMPATIBLE_DRIVER => no_driver(),
            // Loaders also return this code if a listed file is not a driver manifest.
            vk::Result::ERROR_OUT_OF_HOST_MEMORY => Error::NoDevice(format!(
                "the Vulkan loader could load no driver{}, or memory ran out; {A_DRIVER}",
                driver_list()
            )),
            other => vk_error("vkCreateInstance")(other),
        })?;
        let messenger = if validation {
            let functions = ext::debug_utils::Instance::new(&entry, &raw);
            let info = messenger_info(&messages);
            // SAFETY: the callback's user data is the `Arc`'s content, which `Instance` keeps alive
            // until after the messenger is destroyed.
            let handle = unsafe { functions.create_debug_utils_messenger(&info, None) }
                .map_err(vk_error("vkCreateDebugUtilsMessengerEXT"))?;
            Some((functions, handle))
        } else {
            None
        };
        Ok(Instance { raw, messenger, messages, entry: Some(entry) })
    }

    /// Wraps a host's instance without taking ownership.
    pub(super) fn adopt(raw: ash::Instance) -> Instance {
        Instance { raw, messenger: None, messages: Arc::default(), entry: None }
    }

    /// Every physical device that supports Vulkan 1.3 or newer, in the loader's order.
    pub(crate) fn devices(&self) -> Result<Vec<(vk::PhysicalDevice, DeviceInfo)>> {
        let mut usable = self.physical_devices()?;
        usable.retain(|(_, info)| is_recent(info));
        if usable.is_empty() {
            return Err(no_driver());
        }
        Ok(usable)
    }

    /// Every physical device: those that support Vulkan 1.3 or newer, in the loader's order, then the
    /// others.
    fn physical_devices(&self) -> Result<Vec<(vk::PhysicalDevice, DeviceInfo)>> {
        // SAFETY: the instance is alive.
        let devices = unsafe { self.raw.enumerate_physical_devices() }
            .map_err(vk_error("vkEnumeratePhysicalDevices"))?;
        let mut described: Vec<_> = devices.into_iter().map(|d| (d, self.describe(d))).collect();
        described.sort_by_key(|(_, info)| !is_recent(info));
        described.iter_mut().enumerate().for_each(|(index, (_, info))| info.index = index);
        Ok(described)
    }

    pub(super) fn describe(&self, device: vk::PhysicalDevice) -> DeviceInfo {
        let mut vulkan11 = vk::PhysicalDeviceVulkan11Properties::default();
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Properties::default();
        let mut properties = vk::PhysicalDeviceProperties2::default()
            .push_next(&mut vulkan11)
            .push_next(&mut vulkan12);
        // SAFETY: the chain's structures live until the end of the function.
        unsafe { self.raw.get_physical_device_properties2(device, &mut properties) };
        let core = properties.properties;
        // SAFETY: a plain query of a device of this instance.
        let memory = unsafe { self.raw.get_physical_device_memory_properties(device) };
        let memory_bytes = memory.memory_heaps[..memory.memory_heap_count as usize]
            .iter()
            .filter(|heap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL))
            .map(|heap| heap.size)
            .max()
            .unwrap_or(0);
        let string = |chars: &[std::ffi::c_char]| {
            let bytes: Vec<u8> = chars.iter().map(|&c| c as u8).take_while(|&c| c != 0).collect();
            String::from_utf8_lossy(&bytes).into_owned()
        };
        DeviceInfo {
            index: 0,
            name: string(&core.device_name),
            kind: match core.device_type {
                vk::PhysicalDeviceType::DISCRETE_GPU => DeviceKind::Discrete,
                vk::PhysicalDeviceType::INTEGRATED_GPU => DeviceKind::Integrated,
                vk::PhysicalDeviceType::VIRTUAL_GPU => DeviceKind::Virtual,
                vk::PhysicalDeviceType::CPU => DeviceKind::Software,
                _ => DeviceKind::Other,
            },
            driver: format!("{} {}", string(&vulkan12.driver_name), string(&vulkan12.driver_info))
                .trim()
                .to_owned(),
            api_version: core.api_version,
            subgroup_size: vulkan11.subgroup_size,
            memory_bytes,
        }
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        if let Some((functions, handle)) = self.messenger.take() {
            // SAFETY: created from this instance, destroyed once, before it.
            unsafe { functions.destroy_debug_utils_messenger(handle, None) };
        }
        if self.entry.is_some() {
            // SAFETY: this instance is owned; devices hold an `Arc<Instance>`, so none is left.
            unsafe { self.raw.destroy_instance(None) };
        }
    }
}

/// Loads the system's Vulkan loader.
fn load() -> Result<ash::Entry> {
    // SAFETY: loading the loader runs its initialisers, which is what every Vulkan program does.
    unsafe { ash::Entry::load() }.map_err(|_| Error::NoDevice(NO_LOADER.into()))
}

fn is_recent(info: &DeviceInfo) -> bool {
    info.api_version >= vk::API_VERSION_1_3
}

fn no_driver() -> Error {
    Error::NoDevice(format!("the Vulkan loader found no driver{}; {A_DRIVER}", driver_list()))
}

/// The driver list that the loader has used, for messages; empty if the loader searched its own
/// folders.
fn driver_list() -> String {
    let found = DRIVER_LISTS.iter().find_map(|name| Some((name, std::env::var_os(name)?)));
    found.map_or_else(String::new, |(name, list)| {
        let list: String = list.to_string_lossy().chars().take(200).collect();
        format!(" in {name}={list:?}")
    })
}

fn require_layer(entry: &ash::Entry) -> Result<()> {
    // SAFETY: a plain query of the loader.
    let layers = unsafe { entry.enumerate_instance_layer_properties() }
        .map_err(vk_error("vkEnumerateInstanceLayerProperties"))?;
    let present =
        layers.iter().any(|l| l.layer_name_as_c_str().is_ok_and(|name| name == VALIDATION_LAYER));
    match present {
        true => Ok(()),
        false => Err(Error::NoDevice(
            "the Khronos validation layer is not installed (Debian: apt-get install \
             vulkan-validationlayers)"
                .into(),
        )),
    }
}

fn messenger_info(messages: &Arc<Messages>) -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(
            vk::DebugUtilsMessageSeverityFlagsEXT::WARNING
                | vk::DebugUtilsMessageSeverityFlagsEXT::ERROR,
        )
        .message_type(
            vk::DebugUtilsMessageTypeFlagsEXT::GENERAL
                | vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION
                | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
        )
        .pfn_user_callback(Some(on_message))
        .user_data(Arc::as_ptr(messages) as *mut c_void)
}

/// Collects the messages of the validation layer.
///
/// # Safety
/// Called by the layer with the user data given to the messenger: a live `Messages`.
unsafe extern "system" fn on_message(
    _severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    messages: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid callback data, and the messages outlive the messenger.
    let (message, messages) = unsafe {
        let text = (*data).p_message;
        let text = if text.is_null() { c"" } else { CStr::from_ptr(text) };
        (text.to_string_lossy().into_owned(), &*(messages as *const Messages))
    };
    // General messages come from the loader and concern other drivers and layers.
    if kind != vk::DebugUtilsMessageTypeFlagsEXT::GENERAL
        && let Ok(mut list) = messages.lock()
    {
        list.push(message);
    }
    vk::FALSE
}

/// The kind of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceKind {
    /// A GPU with its own memory.
    Discrete,
    /// A GPU that shares the CPU's memory.
    Integrated,
    /// A virtual GPU inside a virtual machine.
    Virtual,
    /// A software driver that runs on the CPU.
    Software,
    /// None of these.
    Other,
}

/// A Vulkan device as its driver describes it.
#[derive(Clone, Debug)]
pub struct DeviceInfo {
    /// Its index in the list of [`enumerate`].
    pub index: usize,
    /// The device name that the driver reports.
    pub name: String,
    /// The kind of the device.
    pub kind: DeviceKind,
    /// The driver's name and version.
    pub driver: String,
    /// The newest supported Vulkan version, in Vulkan's packed encoding.
    pub api_version: u32,
    /// Invocations in a subgroup.
    pub subgroup_size: u32,
    /// Size of the largest device-local heap, bytes.
    pub memory_bytes: u64,
}

/// Every usable device, in the order that `Selector::Index` counts.
///
/// # Errors
/// [`Error::NoDevice`] without a loader or driver, naming the package to install.
pub fn enumerate() -> Result<Vec<DeviceInfo>> {
    let instance = Instance::new(false)?;
    Ok(instance.devices()?.into_iter().map(|(_, info)| info).collect())
}

/// The newest instance version that the Vulkan loader supports, in Vulkan's packed encoding. No driver is
/// loaded.
///
/// # Errors
/// [`Error::NoDevice`] without a loader, naming the package to install.
pub fn loader_version() -> Result<u32> {
    // SAFETY: a plain query of the loader.
    let version = unsafe { load()?.try_enumerate_instance_version() }
        .map_err(vk_error("vkEnumerateInstanceVersion"))?;
    // A loader of Vulkan 1.0 does not have the query.
    Ok(version.unwrap_or(vk::API_VERSION_1_0))
}

/// A device of the machine, and what the engine misses on it.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// The device. Devices below Vulkan 1.3 have the indices after those of [`enumerate`].
    pub info: DeviceInfo,
    /// The properties, features and limits that it lacks, in words; empty if the engine can run.
    pub missing: Vec<String>,
}

/// Every device of the machine, usable or not: first those of [`enumerate`], then those below Vulkan 1.3.
///
/// # Errors
/// [`Error::NoDevice`] without a loader or driver, naming the package to install.
pub fn candidates() -> Result<Vec<Candidate>> {
    let (instance, needed) = (Instance::new(false)?, Requirements::query());
    let devices = instance.physical_devices()?;
    if devices.is_empty() {
        return Err(no_driver());
    }
    let judged = devices.into_iter().map(|(physical, info)| Candidate {
        info,
        missing: needed.lacked_by(&instance.raw, physical),
    });
    Ok(judged.collect())
}
