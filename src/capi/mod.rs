//! The C interface of the engine. `tools/header` generates `include/splat4d.h` from this module.
//!
//! `tools/header/preamble.h`, the head of the header, states the conventions. Every function is
//! `unsafe` because it relies on them: pointers are null or point to what the header states,
//! handles are alive, and one thread at a time uses a handle unless stated otherwise. Every other
//! misuse returns an error, and no panic crosses the C boundary.
//!
//! Types and functions have their C names.

#![allow(unsafe_code, reason = "what a host promises in C, it promises here")]
#![allow(non_camel_case_types, reason = "the names of the header")]
#![allow(clippy::missing_safety_doc, reason = "the header's conventions are every function's")]

mod call;
mod device;
mod memory;
mod ops;
mod record;
mod renderer;
mod scene;
mod trainer;
mod version;
mod vulkan;

pub use call::*;
pub use device::*;
pub use memory::*;
pub use ops::*;
pub use record::*;
pub use renderer::*;
pub use scene::*;
pub use trainer::*;
pub use version::*;
pub use vulkan::*;

/// Checks what the header states about threads.
const _: () = {
    const fn goes<T: Send>() {}
    const fn is_shared<T: Send + Sync>() {}
    is_shared::<splat4d_device>();
    goes::<splat4d_buffer>();
    goes::<splat4d_frame>();
    goes::<splat4d_guard>();
    goes::<splat4d_recorder>();
    goes::<splat4d_renderer>();
    goes::<splat4d_scan>();
    goes::<splat4d_scene>();
    goes::<splat4d_sort>();
    goes::<splat4d_stream>();
    goes::<splat4d_trainer>();
};
