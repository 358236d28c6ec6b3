//! Messages of the validation layer.

use crate::Result;
use crate::gpu::vulkan;
use splat4d::embed::ash::{ext, vk};
use std::ffi::{CStr, c_void};
use std::sync::Mutex;

/// Collects the validation layer's warnings and errors, from [`listen`](Self::listen) to
/// [`finish`](Self::finish).
pub struct Messages {
    functions: ext::debug_utils::Instance,
    messenger: vk::DebugUtilsMessengerEXT,
    said: Box<Mutex<Vec<String>>>,
    /// Dropped after the messenger.
    _instance: wgpu::Instance,
}

/// Appends a message to the list.
///
/// # Safety
/// `data` must point to valid callback data, and `said` to a list that is alive.
unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    said: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid data, and `Messages` keeps the list alive.
    let (text, said) = unsafe {
        (CStr::from_ptr((*data).p_message), &*said.cast_const().cast::<Mutex<Vec<String>>>())
    };
    said.lock().unwrap().push(text.to_string_lossy().into_owned());
    vk::FALSE
}

impl Messages {
    /// Starts to collect messages. wgpu enables the layer and its synchronization validation if the layer is
    /// installed, and continues without it otherwise; here a missing layer is an error.
    pub fn listen(instance: &wgpu::Instance, adapter: &wgpu::Adapter) -> Result<Messages> {
        // SAFETY: the guard is dropped before the adapter, and nothing is destroyed through it.
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
        // SAFETY: the instance was created with the extension; the list stays on the heap until the messenger
        // is destroyed.
        let messenger = unsafe { functions.create_debug_utils_messenger(&info, None) }?;
        Ok(Messages { functions, messenger, said, _instance: instance.clone() })
    }

    /// All messages, in order. The device must have been destroyed before.
    pub fn finish(self) -> Vec<String> {
        std::mem::take(&mut *self.said.lock().unwrap())
    }
}

impl Drop for Messages {
    fn drop(&mut self) {
        // SAFETY: the messenger belongs to this value, and its instance is alive.
        unsafe { self.functions.destroy_debug_utils_messenger(self.messenger, None) };
    }
}
