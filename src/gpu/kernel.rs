//! Declarations of compute kernels: one `kernel!` per shader.

use super::buffer::{View, ViewMut};
use crate::error::{Error, Result};
use crate::vk::{BoundRange, Limits};
use bytemuck::Pod;
use std::marker::PhantomData;

/// How a kernel accesses a binding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Reads only (`readonly` in the shader).
    Read,
    /// Writes only (`writeonly` in the shader).
    Write,
    /// Reads and writes.
    ReadWrite,
}

/// One storage buffer of a kernel's interface.
#[derive(Clone, Copy, Debug)]
pub struct Binding {
    /// The field's name in the Rust declaration.
    pub name: &'static str,
    /// How the kernel accesses it.
    pub access: Access,
    /// Size of one of the shader's elements in bytes.
    pub stride: usize,
}

/// One member of a kernel's push constants.
#[derive(Clone, Copy, Debug)]
pub struct ParamInfo {
    /// The field's name.
    pub name: &'static str,
    /// Offset in bytes.
    pub offset: usize,
    /// Size in bytes.
    pub size: usize,
}

/// The value of a specialisation constant. The functions are named as their types, so that `kernel!`
/// finds them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ConstantValue {
    /// `bool`.
    Bool(bool),
    /// `uint`.
    U32(u32),
    /// `int`.
    I32(i32),
    /// `float`.
    F32(f32),
}

impl ConstantValue {
    /// A `bool`.
    pub const fn bool(value: bool) -> ConstantValue {
        ConstantValue::Bool(value)
    }

    /// A `uint`.
    pub const fn u32(value: u32) -> ConstantValue {
        ConstantValue::U32(value)
    }

    /// An `int`.
    pub const fn i32(value: i32) -> ConstantValue {
        ConstantValue::I32(value)
    }

    /// A `float`.
    pub const fn f32(value: f32) -> ConstantValue {
        ConstantValue::F32(value)
    }

    /// The four bytes that Vulkan takes for it.
    pub const fn word(self) -> u32 {
        match self {
            ConstantValue::Bool(value) => value as u32,
            ConstantValue::U32(value) => value,
            ConstantValue::I32(value) => value as u32,
            ConstantValue::F32(value) => value.to_bits(),
        }
    }
}

/// One specialisation constant of a kernel.
#[derive(Clone, Copy, Debug)]
pub struct ConstantInfo {
    /// The field's name; the shader has it in upper case.
    pub name: &'static str,
    /// Its `constant_id`.
    pub id: u32,
    /// The shader's default, which also tells the type.
    pub default: ConstantValue,
}

/// Values for the specialisation constants of a kernel; `kernel!` implements it. Their defaults are
/// those of the shader.
pub trait Constants: Copy + Default {
    /// The constants, in the order of their ids.
    const INFO: &'static [ConstantInfo];
    /// An array with a word for each constant.
    type Words: AsRef<[u32]>;
    /// The values as Vulkan takes them, in the order of the ids.
    fn words(&self) -> Self::Words;
}

/// No specialisation constants.
impl Constants for () {
    const INFO: &'static [ConstantInfo] = &[];
    type Words = [u32; 0];
    fn words(&self) -> [u32; 0] {
        []
    }
}

/// A kernel as plain data, for lists and checks.
#[derive(Clone, Copy, Debug)]
pub struct KernelInfo {
    /// `family/stem`, the path of the shader below `glsl/` and `spirv/`.
    pub name: &'static str,
    /// The compiled module.
    pub spirv: &'static [u8],
    /// Invocations of a workgroup.
    pub workgroup: [u32; 3],
    /// Storage buffers, in the order of their binding numbers.
    pub bindings: &'static [Binding],
    /// Members of the push constants.
    pub params: &'static [ParamInfo],
    /// Specialisation constants, in the order of their ids.
    pub constants: &'static [ConstantInfo],
}

/// A compute kernel; `kernel!` implements it.
pub trait Kernel {
    /// `family/stem`.
    const NAME: &'static str;
    /// The compiled module.
    const SPIRV: &'static [u8];
    /// Invocations of a workgroup.
    const WORKGROUP: [u32; 3];
    /// Storage buffers, in the order of their binding numbers.
    const BINDINGS: &'static [Binding];
    /// Everything above as data.
    const INFO: KernelInfo;
    /// Push constants.
    type Params: Pod;
    /// Values of the specialisation constants; `()` for a kernel without any.
    type Constants: Constants;
    /// The buffers of one dispatch, by name.
    type Args<'a>;
    /// Adds the buffers in the order of their binding numbers.
    fn bind(args: &Self::Args<'_>, to: &mut Vec<BoundRange>);
}

/// Marks a binding that the kernel reads.
pub struct Read;
/// Marks a binding that the kernel writes without reading.
pub struct Write;
/// Marks a binding that the kernel reads and writes.
pub struct ReadWrite;
/// Marks a binding whose shader element is a vector of `N` elements of the Rust side; the shader
/// handles a remainder of fewer than `N` elements itself.
pub struct Several<A, const N: usize>(PhantomData<A>);
/// Reads vectors of three, tightly packed.
pub type ReadVec3 = Several<Read, 3>;
/// Writes vectors of three, tightly packed.
pub type WriteVec3 = Several<Write, 3>;
/// Reads and writes vectors of three, tightly packed.
pub type ReadWriteVec3 = Several<ReadWrite, 3>;
/// Reads vec4s.
pub type ReadVec4 = Several<Read, 4>;
/// Writes vec4s.
pub type WriteVec4 = Several<Write, 4>;
/// Reads and writes vec4s.
pub type ReadWriteVec4 = Several<ReadWrite, 4>;

/// The Rust side of an access marker: which view a dispatch takes for the binding.
pub trait Argument {
    /// The view that a dispatch takes.
    type Handle<'a, T: 'a>;
    /// The access as data.
    const ACCESS: Access;
    /// Number of Rust elements in one element of the shader.
    const AT_ONCE: usize = 1;
    /// The bound memory.
    fn bound<T>(handle: &Self::Handle<'_, T>) -> BoundRange;
}

impl Argument for Read {
    type Handle<'a, T: 'a> = View<'a, T>;
    const ACCESS: Access = Access::Read;
    fn bound<T>(handle: &View<'_, T>) -> BoundRange {
        handle.bound()
    }
}

impl<A: Argument, const N: usize> Argument for Several<A, N> {
    type Handle<'a, T: 'a> = A::Handle<'a, T>;
    const ACCESS: Access = A::ACCESS;
    const AT_ONCE: usize = N;
    fn bound<T>(handle: &A::Handle<'_, T>) -> BoundRange {
        A::bound(handle)
    }
}

impl Argument for Write {
    type Handle<'a, T: 'a> = ViewMut<'a, T>;
    const ACCESS: Access = Access::Write;
    fn bound<T>(handle: &ViewMut<'_, T>) -> BoundRange {
        handle.bound()
    }
}

impl Argument for ReadWrite {
    type Handle<'a, T: 'a> = ViewMut<'a, T>;
    const ACCESS: Access = Access::ReadWrite;
    fn bound<T>(handle: &ViewMut<'_, T>) -> BoundRange {
        handle.bound()
    }
}

/// The grid of a dispatch, in workgroups.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Groups(pub [u32; 3]);

impl Groups {
    /// Enough workgroups for `items` at `per_group` each, folded into a second axis beyond the
    /// device's limit. The shader computes its group index as `gl_WorkGroupID.y *
    /// gl_NumWorkGroups.x + gl_WorkGroupID.x` and returns if the index is out of range, since the
    /// last row may be padded.
    ///
    /// # Errors
    /// [`Error::Input`] when even the folded grid is too small.
    pub fn linear(items: usize, per_group: u32, limits: &Limits) -> Result<Groups> {
        let groups = (items as u64).div_ceil(u64::from(per_group));
        let limit = u64::from(limits.groups);
        if groups <= limit {
            return Ok(Groups([groups as u32, 1, 1]));
        }
        let rows = groups.div_ceil(limit);
        if rows > limit {
            return Err(Error::Input(format!(
                "{items} items are more than one dispatch can cover"
            )));
        }
        Ok(Groups([limit as u32, rows as u32, 1]))
    }

    /// Enough workgroups of `tile` for an image of `width` × `height`.
    pub fn grid(width: u32, height: u32, tile: [u32; 2]) -> Groups {
        Groups([width.div_ceil(tile[0]), height.div_ceil(tile[1]), 1])
    }

    /// Whether the grid has no workgroups.
    pub fn is_empty(&self) -> bool {
        self.0.contains(&0)
    }
}

/// Declares a compute kernel: a type that implements [`Kernel`], its push constants and its buffers.
///
/// The n-th field of `args` is binding n of set 0; `params` has the layout of the shader's push constants
/// (`repr(C)`, 4-byte scalars). The engine's own kernels use a module below `spirv/`, and
/// `tests/interface.rs` checks each declaration against its module. A kernel of another crate gives
/// its SPIR-V after `from`, and its declaration must match it; that crate needs `bytemuck` with the
/// feature `derive`. A kernel declared `like` another one has the same push constants and bindings.
///
/// A section `constants` declares the specialisation constants 0, 1, … in this order, each `bool`, `u32`,
/// `i32` or `f32`, with the shader's name in lower case and the shader's default.
/// [`Recorder::dispatch_specialised`](crate::gpu::Recorder::dispatch_specialised) takes their values. A
/// kernel that has the constants of another one, or is `like` it, names that struct, without fields.
///
/// ```ignore
/// splat4d::kernel! {
///     /// Multiplies all values by a factor.
///     pub struct Scale("mine/scale") from include_bytes!("scale.spv"), workgroup: [64, 1, 1],
///     constants: ScaleConstants {
///         /// Whether the values are clamped to [0, 1].
///         clamped: bool = false,
///     },
///     params: ScaleParams {
///         /// Number of values.
///         count: u32,
///         /// The factor.
///         factor: f32,
///     },
///     args: ScaleArgs {
///         /// The values.
///         values: ReadWrite<f32>,
///     }
/// }
/// ```
///
/// The repository's `examples/custom_kernel` is a whole program.
#[macro_export]
macro_rules! kernel {
    (
        $(#[$doc:meta])*
        pub struct $name:ident($path:literal) like $other:ident, workgroup: $workgroup:expr
        $(, constants: $constants:ident)?
    ) => {
        $(#[$doc])*
        pub struct $name;

        impl $crate::gpu::Kernel for $name {
            const NAME: &'static str = $path;
            const SPIRV: &'static [u8] =
                include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/spirv/", $path, ".spv"));
            const WORKGROUP: [u32; 3] = $workgroup;
            const BINDINGS: &'static [$crate::gpu::Binding] =
                <$other as $crate::gpu::Kernel>::BINDINGS;
            const INFO: $crate::gpu::KernelInfo = $crate::gpu::KernelInfo {
                name: Self::NAME,
                spirv: Self::SPIRV,
                workgroup: Self::WORKGROUP,
                constants: <Self::Constants as $crate::gpu::Constants>::INFO,
                ..<$other as $crate::gpu::Kernel>::INFO
            };
            type Params = <$other as $crate::gpu::Kernel>::Params;
            #[allow(unused_parens, reason = "without a name they are the type of no constants")]
            type Constants = ($($constants)?);
            type Args<'a> = <$other as $crate::gpu::Kernel>::Args<'a>;
            fn bind(args: &Self::Args<'_>, to: &mut Vec<$crate::vk::BoundRange>) {
                <$other as $crate::gpu::Kernel>::bind(args, to);
            }
        }
    };
    (
        $(#[$doc:meta])*
        pub struct $name:ident($path:literal), workgroup: $($rest:tt)*
    ) => {
        kernel! {
            $(#[$doc])*
            pub struct $name($path)
                from include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/spirv/", $path, ".spv")),
            workgroup: $($rest)*
        }
    };
    (
        $(#[$doc:meta])*
        pub struct $name:ident($path:literal) from $spirv:expr, workgroup: $workgroup:expr,
        $(constants: $constants:ident $({
            $( $(#[$constant_doc:meta])* $constant:ident : $constant_type:ident = $default:expr ),* $(,)?
        })?,)?
        params: $params:ident { $( $(#[$param_doc:meta])* $param:ident : $param_type:ty ),* $(,)? },
        args: $args:ident { $( $(#[$arg_doc:meta])* $arg:ident : $access:ident<$element:ty> ),* $(,)? }
    ) => {
        $(#[$doc])*
        pub struct $name;

        $($(
            #[doc = concat!("Specialisation constants of [`", stringify!($name), "`](struct@", stringify!($name), ").")]
            #[derive(Clone, Copy, Debug, PartialEq)]
            pub struct $constants { $( $(#[$constant_doc])* pub $constant: $constant_type, )* }

            impl Default for $constants {
                fn default() -> $constants {
                    $constants { $( $constant: $default, )* }
                }
            }

            impl $crate::gpu::Constants for $constants {
                const INFO: &'static [$crate::gpu::ConstantInfo] = &{
                    let mut ids = 0;
                    [$({
                        ids += 1;
                        $crate::gpu::ConstantInfo {
                            name: stringify!($constant),
                            id: ids - 1,
                            default: $crate::gpu::ConstantValue::$constant_type($default),
                        }
                    }),*]
                };
                type Words = [u32; Self::INFO.len()];
                fn words(&self) -> Self::Words {
                    [$( $crate::gpu::ConstantValue::$constant_type(self.$constant).word() ),*]
                }
            }
        )?)?

        #[doc = concat!("Push constants of [`", stringify!($name), "`](struct@", stringify!($name), ").")]
        #[repr(C)]
        #[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
        pub struct $params { $( $(#[$param_doc])* pub $param: $param_type, )* }

        #[doc = concat!("Buffers of [`", stringify!($name), "`](struct@", stringify!($name), ").")]
        pub struct $args<'a> {
            $( $(#[$arg_doc])* pub $arg: <$crate::gpu::$access as $crate::gpu::Argument>::Handle<'a, $element>, )*
        }

        impl $crate::gpu::Kernel for $name {
            const NAME: &'static str = $path;
            const SPIRV: &'static [u8] = $spirv;
            const WORKGROUP: [u32; 3] = $workgroup;
            const BINDINGS: &'static [$crate::gpu::Binding] = &[$($crate::gpu::Binding {
                name: stringify!($arg),
                access: <$crate::gpu::$access as $crate::gpu::Argument>::ACCESS,
                stride: size_of::<$element>()
                    * <$crate::gpu::$access as $crate::gpu::Argument>::AT_ONCE,
            }),*];
            const INFO: $crate::gpu::KernelInfo = $crate::gpu::KernelInfo {
                name: Self::NAME,
                spirv: Self::SPIRV,
                workgroup: Self::WORKGROUP,
                bindings: Self::BINDINGS,
                params: &[$($crate::gpu::ParamInfo {
                    name: stringify!($param),
                    offset: std::mem::offset_of!($params, $param),
                    size: size_of::<$param_type>(),
                }),*],
                constants: <Self::Constants as $crate::gpu::Constants>::INFO,
            };
            type Params = $params;
            #[allow(unused_parens, reason = "without a name they are the type of no constants")]
            type Constants = ($($constants)?);
            type Args<'a> = $args<'a>;
            fn bind(args: &$args<'_>, to: &mut Vec<$crate::vk::BoundRange>) {
                to.extend([$( <$crate::gpu::$access as $crate::gpu::Argument>::bound(&args.$arg) ),*]);
            }
        }
    };
}
pub(crate) use kernel;
