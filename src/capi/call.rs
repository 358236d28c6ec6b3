//! Shared parts of all functions of the interface: errors, panics, handles, and extensible
//! structures.

use crate::Error;
use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char};
use std::mem::MaybeUninit;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// The result code of a call.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum splat4d_result {
    /// Success.
    SPLAT4D_OK = 0,
    /// A required pointer or handle is null, or a pointer is not aligned.
    SPLAT4D_ERROR_POINTER = 1,
    /// A structure's struct_size is not set, or the structure has fields set that this library does
    /// not know.
    SPLAT4D_ERROR_STRUCT_SIZE = 2,
    /// An argument is invalid.
    SPLAT4D_ERROR_INPUT = 3,
    /// An array or a buffer is too short, or lengths are inconsistent.
    SPLAT4D_ERROR_SHAPE = 4,
    /// A buffer is larger than one binding of the device may be.
    SPLAT4D_ERROR_RANGE_LIMIT = 5,
    /// There is no Vulkan loader, no driver, or no device that fits the request.
    SPLAT4D_ERROR_NO_DEVICE = 6,
    /// The device, or the library as it was built, lacks something.
    SPLAT4D_ERROR_UNSUPPORTED = 7,
    /// Device memory ran out.
    SPLAT4D_ERROR_OUT_OF_MEMORY = 8,
    /// The device was lost: handles can only be destroyed.
    SPLAT4D_ERROR_DEVICE_LOST = 9,
    /// A Vulkan call failed.
    SPLAT4D_ERROR_VULKAN = 10,
    /// A file could not be read or written.
    SPLAT4D_ERROR_IO = 11,
    /// The content of a file violates its format.
    SPLAT4D_ERROR_FORMAT = 12,
    /// The method did not find a result.
    SPLAT4D_ERROR_FAILED = 13,
    /// The program was compiled for another binary interface.
    SPLAT4D_ERROR_VERSION = 14,
    /// A bug of the library: the handles of the call can only be destroyed.
    SPLAT4D_ERROR_INTERNAL = 15,
}

use splat4d_result::{
    SPLAT4D_ERROR_INPUT, SPLAT4D_ERROR_INTERNAL, SPLAT4D_ERROR_POINTER, SPLAT4D_ERROR_SHAPE,
    SPLAT4D_ERROR_STRUCT_SIZE, SPLAT4D_OK,
};

/// Why a call failed.
pub(super) struct Fault {
    code: splat4d_result,
    message: String,
}

pub(super) type Outcome<T = ()> = Result<T, Fault>;

pub(super) fn fault(code: splat4d_result, message: impl Into<String>) -> Fault {
    Fault { code, message: message.into() }
}

pub(super) fn input(message: impl Into<String>) -> Fault {
    fault(SPLAT4D_ERROR_INPUT, message)
}

pub(super) fn shape(message: impl Into<String>) -> Fault {
    fault(SPLAT4D_ERROR_SHAPE, message)
}

impl From<Error> for Fault {
    fn from(error: Error) -> Fault {
        let code = match &error {
            Error::Vulkan { .. } => splat4d_result::SPLAT4D_ERROR_VULKAN,
            Error::NoDevice(_) => splat4d_result::SPLAT4D_ERROR_NO_DEVICE,
            Error::DeviceLost { .. } => splat4d_result::SPLAT4D_ERROR_DEVICE_LOST,
            Error::OutOfMemory { .. } | Error::TooLarge { .. } => {
                splat4d_result::SPLAT4D_ERROR_OUT_OF_MEMORY
            }
            Error::RangeLimit { .. } => splat4d_result::SPLAT4D_ERROR_RANGE_LIMIT,
            Error::Unsupported { .. } => splat4d_result::SPLAT4D_ERROR_UNSUPPORTED,
            Error::Shape { .. } => SPLAT4D_ERROR_SHAPE,
            Error::Io { .. } => splat4d_result::SPLAT4D_ERROR_IO,
            Error::Format { .. } => splat4d_result::SPLAT4D_ERROR_FORMAT,
            Error::Input(_) => SPLAT4D_ERROR_INPUT,
            Error::Failed(_) | Error::Interrupted { .. } => splat4d_result::SPLAT4D_ERROR_FAILED,
        };
        fault(code, error.to_string())
    }
}

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// Runs the body of a function: an error or a panic becomes a result code, and its message becomes
/// the last error of this thread.
pub(super) fn call(body: impl FnOnce() -> Outcome) -> splat4d_result {
    let fault = match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(())) => return SPLAT4D_OK,
        Ok(Err(fault)) => fault,
        Err(panic) => {
            let what = match (panic.downcast_ref::<&str>(), panic.downcast_ref::<String>()) {
                (Some(text), _) => text,
                (_, Some(text)) => text.as_str(),
                _ => "no message",
            };
            let message = format!("a bug in splat4d, please report it: {what}");
            // The payload is leaked, since dropping an unknown payload may panic.
            std::mem::forget(panic);
            fault(SPLAT4D_ERROR_INTERNAL, message)
        }
    };
    let text = CString::new(fault.message.replace('\0', "\u{fffd}")).unwrap_or_default();
    // A thread that is ending has no thread-local storage left.
    let _ = LAST.try_with(|last| *last.borrow_mut() = text);
    fault.code
}

/// The message of the last failed call on this thread; empty before the first. It is UTF-8, owned
/// by the library, and valid until the next call on this thread fails. A call that succeeds does
/// not change it.
#[unsafe(no_mangle)]
pub extern "C" fn splat4d_last_error() -> *const c_char {
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

/// Returns a handle to the host. It must be the last step of a body, since a later failure would
/// leak the handle.
pub(super) unsafe fn give<T>(to: *mut *mut T, value: T) {
    // SAFETY: `claim` has looked at the pointer.
    unsafe { to.write(Box::into_raw(Box::new(value))) };
}

/// Checks the output pointer of a handle and writes null to it, so that a failure leaves no stale
/// handle.
pub(super) unsafe fn claim<T>(what: &str, to: *mut *mut T) -> Outcome {
    check_pointer(what, to)?;
    // SAFETY: not null and aligned; the rest is guaranteed by the host.
    unsafe { to.write(std::ptr::null_mut()) };
    Ok(())
}

/// Takes ownership of a handle, which is invalid afterwards.
pub(super) unsafe fn take<T>(what: &str, handle: *mut T) -> Outcome<T> {
    check_pointer(what, handle)?;
    // SAFETY: `give` made it, which the host guarantees.
    Ok(*unsafe { Box::from_raw(handle) })
}

/// Drops a handle; null is allowed.
pub(super) unsafe fn destroy<T>(handle: *mut T) {
    call(|| match handle.is_null() {
        true => Ok(()),
        // SAFETY: guaranteed by the host.
        false => unsafe { take("the handle", handle) }.map(drop),
    });
}

/// A shared reference to the target of a handle or a pointer.
pub(super) unsafe fn shared<'a, T>(what: &str, at: *const T) -> Outcome<&'a T> {
    check_pointer(what, at)?;
    // SAFETY: not null and aligned; the rest is guaranteed by the host.
    Ok(unsafe { &*at })
}

/// An exclusive reference to the target of a handle.
pub(super) unsafe fn exclusive<'a, T>(what: &str, at: *mut T) -> Outcome<&'a mut T> {
    check_pointer(what, at)?;
    // SAFETY: not null and aligned; the rest is guaranteed by the host.
    Ok(unsafe { &mut *at })
}

fn check_pointer<T>(what: &str, at: *const T) -> Outcome {
    match at {
        _ if at.is_null() => Err(fault(SPLAT4D_ERROR_POINTER, format!("{what} is null"))),
        _ if !at.is_aligned() => Err(fault(
            SPLAT4D_ERROR_POINTER,
            format!("{what} is not aligned to {} bytes", align_of::<T>()),
        )),
        _ => Ok(()),
    }
}

/// An array of the host; null is allowed for zero elements.
pub(super) unsafe fn array<'a, T>(what: &str, at: *const T, len: usize) -> Outcome<&'a [T]> {
    if len == 0 {
        return Ok(&[]);
    }
    check_pointer(what, at)?;
    check_length::<T>(what, len)?;
    // SAFETY: not null, aligned, and of a valid length; the rest is guaranteed by the host.
    Ok(unsafe { std::slice::from_raw_parts(at, len) })
}

/// An array of the host, to write.
pub(super) unsafe fn array_mut<'a, T>(what: &str, at: *mut T, len: usize) -> Outcome<&'a mut [T]> {
    if len == 0 {
        return Ok(&mut []);
    }
    check_pointer(what, at)?;
    check_length::<T>(what, len)?;
    // SAFETY: as above.
    Ok(unsafe { std::slice::from_raw_parts_mut(at, len) })
}

fn check_length<T>(what: &str, len: usize) -> Outcome {
    match len.checked_mul(size_of::<T>()) {
        Some(bytes) if bytes <= isize::MAX as usize => Ok(()),
        _ => Err(shape(format!("{what} has {len} elements: more than memory"))),
    }
}

/// A text of the host.
pub(super) unsafe fn text<'a>(what: &str, at: *const c_char) -> Outcome<&'a str> {
    check_pointer(what, at)?;
    // SAFETY: not null; it ends with a zero, which the host guarantees.
    let text = unsafe { CStr::from_ptr(at) };
    text.to_str().map_err(|_| input(format!("{what} is not UTF-8")))
}

/// Writes as much of a text as fits, zero-terminated, and the length of the whole text.
pub(super) unsafe fn write_text(
    value: &str,
    to: *mut c_char,
    size: usize,
    length: *mut usize,
) -> Outcome {
    // SAFETY: guaranteed by the host, here and below.
    let to = unsafe { array_mut("text", to.cast::<u8>(), size) }?;
    if let Some((last, room)) = to.split_last_mut() {
        let mut fits = value.len().min(room.len());
        while !value.is_char_boundary(fits) {
            fits -= 1;
        }
        room[..fits].copy_from_slice(&value.as_bytes()[..fits]);
        room[fits..].fill(0);
        *last = 0;
    }
    if !length.is_null() {
        check_pointer("length", length)?;
        // SAFETY: as above.
        unsafe { length.write(value.len()) };
    }
    Ok(())
}

/// An extensible structure: it begins with its size and may get more fields at its end, whose
/// default is zero.
///
/// # Safety
/// `repr(C)`, the first field is `struct_size: usize`, and any fields of zeros are valid.
pub(super) unsafe trait Grows: Copy {
    /// Where the fields of the first version end.
    const FIRST: usize;
}

/// Declares an extensible structure, by its last field in the first version.
macro_rules! grows {
    ($name:ident, $last:ident: $kind:ty) => {
        // SAFETY: `repr(C)`, begins with its size, and made of numbers, pointers, handles and
        // functions that may be null.
        unsafe impl $crate::capi::call::Grows for $name {
            const FIRST: usize = std::mem::offset_of!($name, $last) + size_of::<$kind>();
        }
    };
}
pub(super) use grows;

/// No structure is as large; a larger size means that the size was not set.
const LARGEST: usize = 1 << 16;

/// The size of a host's structure as the host states it. It also serves to check an output
/// structure before the work whose result it gets.
pub(super) unsafe fn size_of_host<T: Grows>(what: &str, at: *const T) -> Outcome<usize> {
    check_pointer(what, at)?;
    // SAFETY: a structure that grows begins with its size.
    let size = unsafe { at.cast::<usize>().read() };
    match size {
        _ if size < T::FIRST || size > LARGEST => Err(fault(
            SPLAT4D_ERROR_STRUCT_SIZE,
            format!("{what}: struct_size is {size}; set it to sizeof of the structure"),
        )),
        _ => Ok(size),
    }
}

/// Reads a host's structure; fields that an older host does not have are zero.
pub(super) unsafe fn read<T: Grows>(what: &str, from: *const T) -> Outcome<T> {
    // SAFETY: guaranteed by the host.
    let size = unsafe { size_of_host(what, from) }?;
    let known = size.min(size_of::<T>());
    let mut value = MaybeUninit::<T>::zeroed();
    // SAFETY: the structure has this many bytes, as it states; zeros and the host's bytes form a
    // valid structure.
    let (value, unknown) = unsafe {
        value.as_mut_ptr().cast::<u8>().copy_from_nonoverlapping(from.cast(), known);
        let rest = std::slice::from_raw_parts(from.cast::<u8>().add(known), size - known);
        (value.assume_init(), rest)
    };
    if unknown.iter().any(|&byte| byte != 0) {
        let message = format!("{what}: a field is set that this version of splat4d does not know");
        return Err(fault(SPLAT4D_ERROR_STRUCT_SIZE, message));
    }
    Ok(value)
}

/// [`read`] with null for all defaults.
pub(super) unsafe fn read_or_zero<T: Grows>(what: &str, from: *const T) -> Outcome<T> {
    match from.is_null() {
        // SAFETY: zeros are valid.
        true => Ok(unsafe { MaybeUninit::<T>::zeroed().assume_init() }),
        // SAFETY: guaranteed by the host.
        false => unsafe { read(what, from) },
    }
}

/// Writes a host's structure up to its size; `struct_size` stays unchanged.
pub(super) unsafe fn write<T: Grows>(what: &str, to: *mut T, value: T) -> Outcome {
    // SAFETY: guaranteed by the host.
    let size = unsafe { size_of_host(what, to) }?;
    let known = size.min(size_of::<T>());
    let head = size_of::<usize>();
    let from = (&raw const value).cast::<u8>();
    // SAFETY: the structure has this many bytes, as it states.
    unsafe {
        to.cast::<u8>().add(head).copy_from_nonoverlapping(from.add(head), known - head);
        to.cast::<u8>().add(known).write_bytes(0, size - known);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn last() -> String {
        // SAFETY: valid until the next failure on this thread.
        unsafe { CStr::from_ptr(splat4d_last_error()) }.to_str().unwrap().to_owned()
    }

    #[test]
    fn a_panic_is_a_code_and_a_message() {
        assert_eq!(call(|| panic!("at {}", 7)), SPLAT4D_ERROR_INTERNAL);
        assert!(last().ends_with("at 7"), "{}", last());
        assert_eq!(call(|| std::panic::panic_any(7)), SPLAT4D_ERROR_INTERNAL);
        assert_eq!(call(|| Ok(())), SPLAT4D_OK);
        assert!(last().ends_with("no message"), "{}", last());
        assert_eq!(call(|| Err(input("a\0b"))), SPLAT4D_ERROR_INPUT);
        assert_eq!(last(), "a\u{fffd}b");
        std::thread::spawn(|| assert_eq!(last(), "")).join().unwrap();
    }

    #[test]
    fn structures_grow_both_ways() {
        #[repr(C)]
        #[derive(Clone, Copy)]
        struct Now {
            struct_size: usize,
            first: u32,
            second: u32,
        }
        grows!(Now, first: u32);
        let mut host = [0u64; 4];
        let at = host.as_mut_ptr();
        // SAFETY: the array is longer than any size that it claims, and aligned.
        unsafe {
            // An older host, which has the first field only: what lies behind it is not read.
            at.cast::<[u32; 4]>().write([12, 0, 5, 6]);
            let read_old =
                read("now", at.cast::<Now>()).unwrap_or_else(|f| panic!("{}", f.message));
            assert_eq!((read_old.first, read_old.second), (5, 0));
            let value = Now { struct_size: 0, first: 8, second: 9 };
            assert!(write("now", at.cast::<Now>(), value).is_ok());
            assert_eq!(at.cast::<[u32; 4]>().read(), [12, 0, 8, 6]);
            // A newer one, with fields behind ours: zero is fine, and written as zero.
            at.write(24);
            at.add(2).write(0);
            assert!(read("now", at.cast::<Now>()).is_ok());
            at.add(2).write(1);
            let code = read("now", at.cast::<Now>()).map_err(|f| f.code).err();
            assert_eq!(code, Some(SPLAT4D_ERROR_STRUCT_SIZE));
            assert!(write("now", at.cast::<Now>(), value).is_ok());
            assert_eq!(at.add(2).read(), 0);
        }
    }
}
