//! What the validation layer says.

use crate::Result;
use crate::gpu::vulkan;
use splat4d::embed::ash::{ext, vk};
use std::ffi::{CStr, c_void};
use std::sync::Mutex;

/// Collects warnings and errors, from when it is made until it is finished.
pub struct Messages {
    functions: ext::debug_utils::Instance,
    messenger: vk::DebugUtilsMessengerEXT,
    said: Box<Mutex<Vec<String>>>,
    /// Dropped after the messenger.
    _instance: wgpu::Instance,
}

/// # Safety
/// As the layer calls it: with messages that live.
unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    said: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid data, and `Messages` keeps the list.
    let (text, said) = unsafe {
        (CStr::from_ptr((*data).p_message), &*said.cast_const().cast::<Mutex<Vec<String>>>())
    };
    said.lock().unwrap().push(text.to_string_lossy().into_owned());
    vk::FALSE
}

impl Messages {
    /// wgpu turns the layer and its synchronization validation on where it finds it, and goes on
    /// without where it does not; here that is an error.
    pub fn listen(instance: &wgpu::Instance, adapter: &wgpu::Adapter) -> Result<Messages> {
        // SAFETY: the guard is gone before the adapter, and nothing is destroyed through it.
        let hal = unsafe { vulkan(adapter) }?;
        let shared = hal.shared_instance();
        // SAFETY: a plain query.
        let layers = unsafe { shared.entry().enumerate_instance_layer_properties() }?;
        let layer = c"VK_LAYER_KHRONOS_validation";
        if !layers.iter().any(|found| found.layer_name_as_c_str() == Ok(layer)) {
            let what = "the Khronos validation layer is not installed (Debian: \
                        vulkan-validationlayers)";
            return Err(what.into());
        }
        let said = Box::new(Mutex::new(Vec::new()));
        let functions = ext::debug_utils::Instance::new(shared.entry(), shared.raw_instance());
        let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
            .message_severity(
                vk::DebugUtilsMessageSeverityFlagsEXT::WARNING
                    | vk::DebugUtilsMessageSeverityFlagsEXT::ERROR,
            )
            .message_type(
                vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION
                    | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
            )
            .pfn_user_callback(Some(on_message))
            .user_data((&raw const *said).cast_mut().cast());
        // SAFETY: the instance was made with the extension; the list lies on the heap until the
        // messenger is destroyed.
        let messenger = unsafe { functions.create_debug_utils_messenger(&info, None) }?;
        Ok(Messages { functions, messenger, said, _instance: instance.clone() })
    }

    /// Everything said, in order; the device must be gone.
    pub fn finish(self) -> Vec<String> {
        std::mem::take(&mut *self.said.lock().unwrap())
    }
}

impl Drop for Messages {
    fn drop(&mut self) {
        // SAFETY: its own messenger, of an instance that lives.
        unsafe { self.functions.destroy_debug_utils_messenger(self.messenger, None) };
    }
}
