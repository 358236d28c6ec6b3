//! Opens a Vulkan device and creates buffers, streams and pipelines on it.

use super::buffer::{Buffer, Readback};
use super::kernel::Kernel;
use super::meter::{Detail, Meter};
use super::profile::Profile;
use super::recorder::Work;
use super::stream::{KernelTime, Stream};
use crate::error::{Error, Result};
use crate::vk::{
    self, CommandSlot, Context, DeviceInfo, DeviceKind, Ledger, Limits, Pipeline, PipelineShape,
    RawBuffer, Residence,
};
use bytemuck::Pod;
use std::collections::{BTreeSet, HashMap};
use std::sync::{Arc, Mutex, MutexGuard};

/// Which device to open.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Selector {
    /// The best GPU, or a software driver if there is no GPU.
    #[default]
    Best,
    /// The best GPU, in the order discrete, integrated, virtual. A software driver does not match.
    Gpu,
    /// The device at this index in the list of [`vk::enumerate`](crate::vk::enumerate).
    Index(usize),
    /// The first device whose name contains this text; case is ignored.
    Name(String),
    /// The first device of this kind.
    Kind(DeviceKind),
}

/// A number selects by index. `best`, `gpu`, `discrete`, `integrated`, `virtual` and `software` (or
/// `cpu`) select by kind. Any other text selects by part of the name.
impl From<&str> for Selector {
    fn from(text: &str) -> Selector {
        match text {
            "best" => Selector::Best,
            "gpu" => Selector::Gpu,
            "discrete" => Selector::Kind(DeviceKind::Discrete),
            "integrated" => Selector::Kind(DeviceKind::Integrated),
            "virtual" => Selector::Kind(DeviceKind::Virtual),
            "software" | "cpu" => Selector::Kind(DeviceKind::Software),
            _ => match text.parse() {
                Ok(index) => Selector::Index(index),
                Err(_) => Selector::Name(text.to_owned()),
            },
        }
    }
}

/// The options for opening a device.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// Which device.
    pub selector: Selector,
    /// Enables the Khronos validation layer with synchronization validation. With it, no thread may
    /// create or drop a device while another thread uses one: the layer (seen with 1.3.239) keeps
    /// its devices in a table without a lock, and crashes.
    pub validation: bool,
    /// Limits to use instead of the device's own; for tests of boundary cases.
    pub limits: Option<Limits>,
    /// The profile to use instead of that of the device's kind; for tests of the variants of kernels
    /// that another kind of device runs.
    pub profile: Option<Profile>,
}

impl Request {
    /// A request for the first software driver.
    pub fn software() -> Request {
        Request { selector: Selector::Kind(DeviceKind::Software), ..Request::default() }
    }
}

/// An open Vulkan device. Clones share it.
#[derive(Clone)]
pub struct Device {
    pub(crate) inner: Arc<DeviceInner>,
}

pub(crate) struct DeviceInner {
    pub(crate) context: Arc<Context>,
    pub(crate) limits: Limits,
    profile: Profile,
    /// The subgroup size that pipelines require; `None`: the driver's default.
    subgroup: Option<u32>,
    /// Counts the bytes of the buffers. It is the context's ledger, except in a rehearsal, which
    /// has its own.
    pub(crate) ledger: Arc<Ledger>,
    /// SPIR-V modules that replace the crate's own, by kernel name.
    modules: HashMap<&'static str, Vec<u8>>,
    /// Shared by devices that differ only in the profile and the subgroup size.
    pipelines: Arc<Pipelines>,
    /// What was dispatched; `None` except while a check case runs.
    trace: Option<Arc<Mutex<BTreeSet<Dispatched>>>>,
    /// Recording resources of finished recordings into a host's command buffers, kept for reuse.
    spare: Mutex<Vec<Work>>,
    /// `None` while the meter is off.
    meter: Mutex<Option<Meter>>,
}

/// A kernel, in the variant that a device of some profile dispatched.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Dispatched {
    /// The kernel's name.
    pub kernel: &'static str,
    /// Its specialisation constants, in the order of their ids, as
    /// [`ConstantValue::word`](super::ConstantValue::word) gives them.
    pub constants: Vec<u32>,
    /// The name of the profile.
    pub profile: &'static str,
}

/// A pipeline of a kernel, with what it was compiled for.
struct Variant {
    specialisation: Vec<u32>,
    subgroup: Option<u32>,
    pipeline: Arc<Pipeline>,
}

/// The variants by kernel name.
type Pipelines = Mutex<HashMap<&'static str, Vec<Variant>>>;

impl DeviceInner {
    fn new(context: Arc<Context>) -> DeviceInner {
        let (limits, profile) = (context.limits, Profile::of(context.info.kind));
        let ledger = context.ledger.clone();
        let (subgroup, modules, pipelines, trace, spare, meter) = Default::default();
        DeviceInner {
            context,
            limits,
            profile,
            subgroup,
            ledger,
            modules,
            pipelines,
            trace,
            spare,
            meter,
        }
    }

    /// The same, without the resources and the meter of its recordings.
    fn like(&self) -> DeviceInner {
        DeviceInner {
            limits: self.limits,
            profile: self.profile,
            subgroup: self.subgroup,
            ledger: self.ledger.clone(),
            modules: self.modules.clone(),
            pipelines: self.pipelines.clone(),
            trace: self.trace.clone(),
            ..DeviceInner::new(self.context.clone())
        }
    }
}

impl Device {
    /// Opens a device.
    ///
    /// # Errors
    /// [`Error::NoDevice`] when there is no loader or driver, or none fits the request;
    /// [`Error::Unsupported`] when the device lacks what the engine needs.
    pub fn open(request: &Request) -> Result<Device> {
        let instance = Arc::new(vk::Instance::new(request.validation)?);
        let devices = instance.devices()?;
        let infos: Vec<_> = devices.iter().map(|(_, info)| info.clone()).collect();
        let chosen = choose(&infos, &request.selector)?;
        let (physical, info) = devices[chosen].clone();
        let context = Arc::new(Context::open(instance, physical, info)?);
        let limits = request.limits.unwrap_or(context.limits);
        let profile = request.profile.unwrap_or(Profile::of(context.info.kind));
        Ok(Device::of(DeviceInner { limits, profile, ..DeviceInner::new(context) }))
    }

    fn of(inner: DeviceInner) -> Device {
        Device { inner: Arc::new(inner) }
    }

    /// A device that a host has created.
    pub(crate) fn adopted(context: Arc<Context>) -> Device {
        Device::of(DeviceInner::new(context))
    }

    /// The same device with different limits; for tests of boundary cases. Streams and buffers of
    /// both can be used together.
    pub fn with_limits(&self, limits: Limits) -> Device {
        Device::of(DeviceInner { limits, pipelines: Arc::default(), ..self.inner.like() })
    }

    /// The same device with another profile; for tests of the variants of kernels that another kind of
    /// device runs. Both share streams, buffers and pipelines, but an op needs a scratch of its own
    /// profile.
    pub fn with_profile(&self, profile: Profile) -> Device {
        Device::of(DeviceInner { profile, ..self.inner.like() })
    }

    /// The same device with a subgroup size that its pipelines require; for tests of the sizes among
    /// which the driver may choose. Both share streams, buffers and pipelines, but an op and its scratch
    /// belong to the device for which they were planned.
    ///
    /// # Errors
    /// [`Error::Input`] unless it is one of [`subgroup_sizes`](Self::subgroup_sizes).
    pub fn with_subgroup_size(&self, size: u32) -> Result<Device> {
        let sizes = self.subgroup_sizes();
        if !sizes.contains(&size) {
            let name = &self.info().name;
            return Err(Error::Input(format!(
                "{name}: kernels cannot require subgroups of {size}; sizes that they can require: {sizes:?}"
            )));
        }
        let subgroup = Some(size);
        Ok(Device::of(DeviceInner { subgroup, ..self.inner.like() }))
    }

    /// The subgroup sizes that kernels of up to 256 invocations can require, ascending; empty if the driver
    /// does not let them require any.
    pub fn subgroup_sizes(&self) -> &[u32] {
        &self.inner.context.subgroup_sizes
    }

    /// Invocations in a subgroup: the size that pipelines require, or else the driver's default.
    pub fn subgroup_size(&self) -> u32 {
        self.inner.subgroup.unwrap_or(self.info().subgroup_size)
    }

    /// The same device with another SPIR-V module for one kernel. `Device::with_module` in `embed`
    /// states what the module must satisfy.
    pub(crate) fn replacing(&self, kernel: &'static str, spirv: Vec<u8>) -> Device {
        let mut inner = DeviceInner { pipelines: Arc::default(), ..self.inner.like() };
        inner.modules.insert(kernel, spirv);
        Device::of(inner)
    }

    /// The same device, which remembers what it dispatches, and so do the devices made from it.
    #[cfg(feature = "check")]
    pub(crate) fn tracing(&self) -> Device {
        Device::of(DeviceInner { trace: Some(Arc::default()), ..self.inner.like() })
    }

    /// The kernels and variants dispatched so far; empty unless the device is tracing.
    #[cfg(feature = "check")]
    pub(crate) fn dispatched(&self) -> BTreeSet<Dispatched> {
        let trace = self.inner.trace.as_ref();
        trace.map(|trace| trace.lock().expect("no holder panics").clone()).unwrap_or_default()
    }

    /// Adds a dispatch to the trace, if there is one.
    pub(super) fn trace(&self, kernel: &'static str, constants: &[u32]) {
        if let Some(trace) = &self.inner.trace {
            let (constants, profile) = (constants.to_vec(), self.inner.profile.name());
            let dispatched = Dispatched { kernel, constants, profile };
            trace.lock().expect("no holder panics").insert(dispatched);
        }
    }

    /// The driver's description of the device.
    pub fn info(&self) -> &DeviceInfo {
        &self.inner.context.info
    }

    /// The limits that kernels and ops must respect.
    pub fn limits(&self) -> &Limits {
        &self.inner.limits
    }

    /// What decides which variants of kernels the ops run.
    pub fn profile(&self) -> &Profile {
        &self.inner.profile
    }

    /// The number of buffers, command pools, descriptor pools and query pools created so far. It
    /// stays constant in steady-state work.
    pub fn allocations(&self) -> u64 {
        self.inner.context.allocations()
    }

    /// The number of pipelines compiled so far. A kernel has one pipeline for each set of its
    /// specialisation constants and each required subgroup size; it lives as long as the device.
    pub fn pipelines(&self) -> usize {
        let pipelines = self.inner.pipelines.lock().expect("no holder panics");
        pipelines.values().map(Vec::len).sum()
    }

    /// Whether the device was created by a host and adopted.
    pub fn is_adopted(&self) -> bool {
        self.inner.context.is_adopted()
    }

    /// Whether the buffer was created on this device.
    pub(crate) fn owns(&self, buffer: &RawBuffer) -> bool {
        Arc::ptr_eq(buffer.ledger(), &self.inner.ledger)
    }

    /// Takes recording resources for a host's command buffer, reusing returned ones if there are
    /// any.
    pub(crate) fn take_spare(&self) -> Work {
        let spare = self.inner.spare.lock().expect("no holder panics").pop();
        spare.unwrap_or_else(|| Work::new(CommandSlot::without_buffer(&self.inner.context)))
    }

    /// Returns recording resources that the device no longer uses.
    pub(crate) fn give_spare(&self, mut work: Work) {
        work.clear();
        self.inner.spare.lock().expect("no holder panics").push(work);
    }

    /// Bytes of all live buffers now, and their peak so far.
    pub fn memory(&self) -> (u64, u64) {
        self.inner.ledger.bytes()
    }

    /// Resets the peak memory statistic and returns the bytes of all live buffers.
    pub fn restart_memory_peak(&self) -> u64 {
        self.inner.ledger.restart_peak()
    }

    /// Bytes of device-local memory left for buffers: measured against the budget that the driver
    /// reports for this process, or against the size of the largest heap if the driver reports
    /// none.
    pub fn free_memory(&self) -> u64 {
        self.inner.context.free_memory()
    }

    /// The same device for a rehearsal: buffers are counted but get no memory, dispatches are
    /// checked but not recorded, and downloads return zeros.
    pub(super) fn rehearsing(&self) -> Device {
        Device::of(DeviceInner { ledger: Arc::default(), ..self.inner.like() })
    }

    /// Whether this device is a rehearsal device.
    pub(crate) fn is_rehearsing(&self) -> bool {
        !Arc::ptr_eq(&self.inner.ledger, &self.inner.context.ledger)
    }

    /// Allocates a buffer; in a rehearsal it is only counted.
    pub(super) fn raw_buffer(
        &self,
        bytes: u64,
        residence: Residence,
        label: &str,
    ) -> Result<RawBuffer> {
        let DeviceInner { context, ledger, .. } = &*self.inner;
        match self.is_rehearsing() {
            true => Ok(RawBuffer::imagined(context, ledger, bytes, residence, label)),
            false => RawBuffer::new(context, bytes, residence, label),
        }
    }

    /// Starts summing the device time of the submissions of all its streams, from timestamps at the
    /// start and the end of each submission. Uploads and downloads are not counted. Returns false,
    /// and measures nothing, if the device has no timestamps.
    pub fn start_meter(&self, detail: Detail) -> bool {
        let on = self.limits().timestamp_period > 0.0;
        *self.meter() = on.then(|| Meter::new(detail));
        on
    }

    /// Stops the meter and returns its result; `None` if the meter was off. The result covers the
    /// recordings that were started after the meter was and whose submissions have been waited for.
    pub fn stop_meter(&self) -> Option<Meter> {
        self.meter().take()
    }

    fn meter(&self) -> MutexGuard<'_, Option<Meter>> {
        self.inner.meter.lock().expect("no holder panics")
    }

    pub(super) fn metered(&self) -> Option<Detail> {
        self.meter().as_ref().map(|meter| meter.detail)
    }

    pub(super) fn add_to_meter(&self, ticks: u64, kernels: Vec<KernelTime>) {
        if let Some(meter) = &mut *self.meter() {
            meter.nanoseconds += ticks as f64 * f64::from(self.limits().timestamp_period);
            meter.kernels.extend(kernels);
        }
    }

    /// The messages of the validation layer since the last call; always empty without the layer.
    pub fn take_validation_messages(&self) -> Vec<String> {
        self.inner.context.take_messages()
    }

    /// A buffer of `len` elements with undefined content. A length of zero is legal.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn buffer<T: Pod>(&self, label: &str, len: usize) -> Result<Buffer<T>> {
        Buffer::new(self, label, len)
    }

    /// A buffer with the given content. Waits until the upload has finished. Steady-state work
    /// writes into existing buffers with [`Recorder::update`](super::Recorder::update) instead.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], or a failed submission.
    pub fn upload<T: Pod>(&self, label: &str, data: &[T]) -> Result<Buffer<T>> {
        let mut buffer = Buffer::new(self, label, data.len())?;
        self.stream()?.upload(&mut buffer, data)?;
        Ok(buffer)
    }

    /// Host-visible memory for `len` elements, as the target of device copies.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn readback<T: Pod>(&self, len: usize) -> Result<Readback<T>> {
        Readback::new(self, len)
    }

    /// A stream of submissions on the device's queue.
    ///
    /// # Errors
    /// A failed Vulkan call.
    pub fn stream(&self) -> Result<Stream> {
        Stream::new(self)
    }

    /// The pipeline of a kernel for these specialisation constants; compiled at its first use.
    pub(crate) fn pipeline<K: Kernel>(&self, specialisation: &[u32]) -> Result<Arc<Pipeline>> {
        let mut pipelines = self.inner.pipelines.lock().expect("no holder panics");
        let variants = pipelines.entry(K::NAME).or_default();
        let subgroup = self.inner.subgroup;
        let found = variants.iter().find(|variant| {
            variant.specialisation == specialisation && variant.subgroup == subgroup
        });
        if let Some(variant) = found {
            return Ok(variant.pipeline.clone());
        }
        let pipeline = Arc::new(Pipeline::new(
            &self.inner.context,
            &PipelineShape {
                name: K::NAME,
                spirv: self.inner.modules.get(K::NAME).map_or(K::SPIRV, Vec::as_slice),
                bindings: K::BINDINGS.len() as u32,
                push_bytes: size_of::<K::Params>() as u32,
                workgroup: K::WORKGROUP,
                subgroup,
                specialisation,
            },
        )?);
        variants.push(Variant {
            specialisation: specialisation.to_vec(),
            subgroup,
            pipeline: pipeline.clone(),
        });
        Ok(pipeline)
    }
}

/// The kinds of GPUs, the preferred first.
const GPUS: [DeviceKind; 3] = [DeviceKind::Discrete, DeviceKind::Integrated, DeviceKind::Virtual];

fn choose(infos: &[DeviceInfo], selector: &Selector) -> Result<usize> {
    let first_of = |kind: &DeviceKind| infos.iter().position(|info| info.kind == *kind);
    let found = match selector {
        Selector::Best => {
            GPUS.iter().chain(&[DeviceKind::Other, DeviceKind::Software]).find_map(first_of)
        }
        Selector::Gpu => GPUS.iter().find_map(first_of),
        Selector::Index(index) => (*index < infos.len()).then_some(*index),
        Selector::Name(part) => {
            let part = part.to_lowercase();
            infos.iter().position(|info| info.name.to_lowercase().contains(&part))
        }
        Selector::Kind(kind) => first_of(kind),
    };
    found.ok_or_else(|| {
        let names: Vec<_> =
            infos.iter().map(|info| format!("{} {}", info.index, info.name)).collect();
        Error::NoDevice(format!("no device fits {selector:?}; there are: {}", names.join(", ")))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selectors_name_a_device_by_kind_index_or_name() {
        let info = |(index, kind): (usize, DeviceKind)| DeviceInfo {
            index,
            name: format!("Card {index}"),
            kind,
            driver: String::new(),
            api_version: 0,
            subgroup_size: 32,
            memory_bytes: 0,
        };
        let list = |kinds: &[DeviceKind]| -> Vec<DeviceInfo> {
            kinds.iter().copied().enumerate().map(info).collect()
        };
        use DeviceKind::{Discrete, Integrated, Other, Software, Virtual};
        let all = list(&[Software, Virtual, Other, Integrated, Discrete, Discrete]);
        let chosen = |infos: &[DeviceInfo], text: &str| choose(infos, &text.into()).ok();
        for (text, expected) in [
            ("best", 4),
            ("gpu", 4),
            ("discrete", 4),
            ("integrated", 3),
            ("virtual", 1),
            ("software", 0),
            ("cpu", 0),
            ("5", 5),
            ("card 2", 2),
        ] {
            assert_eq!(chosen(&all, text), Some(expected), "{text}");
        }
        // An integrated GPU is a GPU, but not a discrete one; a software driver is neither.
        let laptop = list(&[Software, Integrated]);
        assert_eq!((chosen(&laptop, "gpu"), chosen(&laptop, "discrete")), (Some(1), None));
        let server = list(&[Software]);
        assert_eq!((chosen(&server, "gpu"), chosen(&server, "best")), (None, Some(0)));
    }
}
