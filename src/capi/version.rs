//! Versions of the library and of its binary interface.

use super::call::{call, fault, splat4d_result};

/// Version of the library of this header. Before 1.0 a minor version may break the interface.
pub const SPLAT4D_VERSION_MAJOR: u32 = 0;
/// As above.
pub const SPLAT4D_VERSION_MINOR: u32 = 1;
/// As above.
pub const SPLAT4D_VERSION_PATCH: u32 = 0;

/// Version of the binary interface: it changes when programs must be recompiled.
pub const SPLAT4D_ABI_VERSION: u32 = 1;

const _: () = {
    assert!(is(env!("CARGO_PKG_VERSION_MAJOR"), SPLAT4D_VERSION_MAJOR));
    assert!(is(env!("CARGO_PKG_VERSION_MINOR"), SPLAT4D_VERSION_MINOR));
    assert!(is(env!("CARGO_PKG_VERSION_PATCH"), SPLAT4D_VERSION_PATCH));
};

const fn is(text: &str, number: u32) -> bool {
    let (digits, mut value, mut at) = (text.as_bytes(), 0, 0);
    while at < digits.len() {
        value = 10 * value + (digits[at] - b'0') as u32;
        at += 1;
    }
    value == number
}

/// Version of the loaded library: major * 1000000 + minor * 1000 + patch.
#[unsafe(no_mangle)]
pub extern "C" fn splat4d_version() -> u32 {
    SPLAT4D_VERSION_MAJOR * 1_000_000 + SPLAT4D_VERSION_MINOR * 1000 + SPLAT4D_VERSION_PATCH
}

/// Checks that the loaded library is compatible with programs compiled with this header. Call it
/// once, with SPLAT4D_ABI_VERSION, before any other function. Returns SPLAT4D_ERROR_VERSION if it
/// is not.
#[unsafe(no_mangle)]
pub extern "C" fn splat4d_check_abi(abi_version: u32) -> splat4d_result {
    call(|| match abi_version == SPLAT4D_ABI_VERSION {
        true => Ok(()),
        false => Err(fault(
            splat4d_result::SPLAT4D_ERROR_VERSION,
            format!(
                "the program was compiled for binary interface {abi_version}, the library has \
                 {SPLAT4D_ABI_VERSION}; compile the program with the library's own header"
            ),
        )),
    })
}
