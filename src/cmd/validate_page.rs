//! The report of `validate` as one self-contained page, to attach to a report of a driver's fault. It holds
//! the modules of the kernels that failed cases ran.

use std::collections::BTreeSet;
use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use splat4d::check::Finding;
use splat4d::gpu::{Access, ConstantValue, Device, Dispatched, KernelInfo};
use splat4d::report::escape;
use splat4d::vk::{self, DeviceInfo, Limits};
use splat4d::{Result, bench, kernels};

use super::common::{bytes, vulkan_version};
use super::doctor::Findings;
use super::rows::{self, Row};
use super::{doctor_machine, page};

const STYLE: &str = "\
dt{flex:none}dd{min-width:0}table{margin:.6rem 0}th,td{text-align:left;vertical-align:top}\
pre{overflow-x:auto;font-size:12px}";

/// A device that was tested.
pub struct Tested {
    info: DeviceInfo,
    limits: Limits,
    subgroup_sizes: Vec<u32>,
    profile: &'static str,
}

impl Tested {
    /// What the page tells of a device.
    pub fn of(device: &Device) -> Tested {
        Tested {
            info: device.info().clone(),
            limits: *device.limits(),
            subgroup_sizes: device.subgroup_sizes().to_vec(),
            profile: device.profile().name(),
        }
    }
}

/// What the page shows.
pub struct Page<'a> {
    pub devices: &'a [Tested],
    pub rows: &'a [Row],
    /// The selection of cases and options, by name.
    pub options: &'a [(&'a str, String)],
}

impl Page<'_> {
    /// The HTML page.
    ///
    /// # Errors
    /// The Vulkan loader cannot be asked for its version.
    pub fn html(&self) -> Result<String> {
        let failed = self.failed().count();
        let mut body = match failed {
            0 => format!("<p>None of {} cases failed.</p>\n", self.rows.len()),
            _ => format!("<p class=\"doubt\">{failed} of {} cases failed.</p>\n", self.rows.len()),
        };
        page::facts(&mut body, self.options);
        machine(&mut body, &vulkan_version(vk::loader_version()?));
        for device in self.devices {
            describe(&mut body, device);
            for row in self.failed().filter(|row| row.device() == device.info.index) {
                failure(&mut body, row);
            }
        }
        self.modules(&mut body);
        let infos: Vec<_> = self.devices.iter().map(|device| device.info.clone()).collect();
        let table = escape(&rows::table(&infos, self.rows));
        let _ = writeln!(body, "<h2>All cases</h2>\n<pre>{table}</pre>");
        let title = match &infos[..] {
            [one] => format!("splat4d validate: {}", one.name),
            many => format!("splat4d validate: {} devices", many.len()),
        };
        Ok(page::document(&title, STYLE, &body))
    }

    fn failed(&self) -> impl Iterator<Item = &Row> {
        self.rows.iter().filter(|row| !row.is_fine())
    }

    /// The kernels of the failed cases, with their modules as links to save.
    fn modules(&self, body: &mut String) {
        let dispatched = self.failed().flat_map(|row| &row.outcome().dispatched);
        let names: BTreeSet<&str> = dispatched.map(|dispatched| dispatched.kernel).collect();
        if names.is_empty() {
            return;
        }
        body.push_str(
            "<h2>Kernels of the failed cases</h2>\n<p>The links save the SPIR-V modules. Their entry point \
             is <code>main</code>; the storage buffers are those of descriptor set 0, in the order of \
             their bindings.</p>\n<div class=\"wide\"><table><thead><tr><th>kernel</th><th>module</th>\
             <th>workgroup</th><th>storage buffers</th><th>push constants</th></tr></thead><tbody>",
        );
        for info in kernels::ALL.iter().filter(|info| names.contains(info.name)) {
            module(body, info);
        }
        body.push_str("</tbody></table></div>\n");
    }
}

/// The program, the machine and the environment, as `doctor` finds them.
fn machine(body: &mut String, loader: &str) {
    let mut findings = Findings::default();
    doctor_machine::program(&mut findings);
    findings.ok("commit", bench::commit().unwrap_or("unknown".into()));
    doctor_machine::system(&mut findings);
    findings.ok("Vulkan loader", loader);
    doctor_machine::environment(&mut findings);
    body.push_str("<h2>Program and machine</h2>\n");
    page::facts(body, &findings.facts());
}

fn describe(body: &mut String, device: &Tested) {
    let Tested { info, limits, subgroup_sizes, profile } = device;
    let sizes: Vec<_> = subgroup_sizes.iter().map(u32::to_string).collect();
    let required = match sizes.is_empty() {
        true => "none".to_owned(),
        false => sizes.join(", "),
    };
    let timestamps = match limits.timestamp_period {
        0.0 => "none".to_owned(),
        period => format!("{period} ns a tick"),
    };
    let _ = writeln!(body, "<h2>Device {}: {}</h2>", info.index, escape(&info.name));
    let facts = [
        ("Driver", info.driver.clone()),
        ("Kind", format!("{:?}", info.kind).to_lowercase()),
        ("Vulkan", vulkan_version(info.api_version)),
        ("Largest device-local heap", bytes(info.memory_bytes)),
        ("Subgroup size", info.subgroup_size.to_string()),
        ("Subgroup sizes that can be required", required),
        ("Profile of kernel variants", (*profile).to_owned()),
        ("Workgroups along an axis, at most", limits.groups.to_string()),
        ("Size of a storage binding, at most", bytes(limits.storage_range)),
        ("Alignment of a storage binding", bytes(limits.storage_alignment)),
        ("Timestamps", timestamps),
    ];
    page::facts(body, &facts);
}

fn failure(body: &mut String, row: &Row) {
    let outcome = row.outcome();
    let (result, reason) = row.result();
    let _ = write!(
        body,
        "<h3>{}: {result}</h3>\n<p>Seed {}. To repeat it: <code>{}</code></p>\n",
        escape(outcome.id),
        outcome.seed,
        escape(&row.again())
    );
    let mut said: Vec<String> = reason.iter().map(|reason| format!("expected: {reason}")).collect();
    said.extend(outcome.error.iter().map(|error| format!("error: {error}")));
    said.extend(row.messages().iter().map(|message| format!("validation layer: {message}")));
    page::notes(body, &said);
    let failures: Vec<&Finding> = row.failures().collect();
    if !failures.is_empty() {
        body.push_str(
            "<div class=\"wide\"><table><thead><tr><th>output</th><th>at</th><th>expected</th><th>got</th>\
             <th>off by at most</th><th>bound</th><th>times the bound</th><th>oracle in f32</th></tr></thead>\
             <tbody>",
        );
        failures.iter().for_each(|finding| comparison(body, finding));
        body.push_str("</tbody></table></div>\n");
    }
    if !outcome.dispatched.is_empty() {
        body.push_str("<p>It ran these kernels:</p>\n<ul>");
        outcome.dispatched.iter().for_each(|dispatched| variant(body, dispatched));
        body.push_str("</ul>\n");
    }
}

fn comparison(body: &mut String, f: &Finding) {
    let bound = match f.bound {
        Some(bound) => format!("{:e} + {:e} of the truth", bound.absolute, bound.relative),
        None => "equality".into(),
    };
    let of_bound = f.bound.map(|_| format!("{:.3}", f.worst_of_bound));
    let own = f.oracle_f32_of_bound.map(|share| format!("{share:.3} times the bound"));
    let _ = write!(
        body,
        "<tr><td>{}</td><td>{} of {}</td><td>{}</td><td>{}</td><td>{}</td><td>{bound}</td><td>{}</td>\
         <td>{}</td></tr>",
        escape(&f.output),
        f.worst_at,
        f.count,
        escape(&f.expected),
        escape(&f.got),
        f.bound.map_or(String::new(), |_| format!("{:.3e}", f.worst_absolute)),
        of_bound.unwrap_or_default(),
        own.unwrap_or_default()
    );
}

/// A kernel with the profile and the specialisation constants that a case ran it with.
fn variant(body: &mut String, dispatched: &Dispatched) {
    let info = kernels::ALL.iter().find(|info| info.name == dispatched.kernel);
    let declared = info.map_or(&[][..], |info| info.constants);
    let constants: Vec<_> = declared
        .iter()
        .zip(&dispatched.constants)
        .map(|(constant, &word)| {
            let value = match constant.default {
                ConstantValue::Bool(_) => (word != 0).to_string(),
                ConstantValue::U32(_) => word.to_string(),
                ConstantValue::I32(_) => (word as i32).to_string(),
                ConstantValue::F32(_) => f32::from_bits(word).to_string(),
            };
            format!(", {} ({}) = {value}", constant.name, constant.id)
        })
        .collect();
    let name = escape(dispatched.kernel);
    let _ = write!(
        body,
        "<li><a href=\"#{name}\">{name}</a>, profile {}{}</li>",
        escape(dispatched.profile),
        escape(&constants.concat())
    );
}

fn module(body: &mut String, info: &KernelInfo) {
    let buffers: Vec<_> = info
        .bindings
        .iter()
        .map(|binding| {
            let access = match binding.access {
                Access::Read => "read",
                Access::Write => "written",
                Access::ReadWrite => "read and written",
            };
            format!("{} ({access}, elements of {} B)", binding.name, binding.stride)
        })
        .collect();
    let params: Vec<_> =
        info.params.iter().map(|param| format!("{} at {} B", param.name, param.offset)).collect();
    let (name, [x, y, z]) = (escape(info.name), info.workgroup);
    let file = escape(&format!("{}.spv", info.name.replace('/', "-")));
    let _ = write!(
        body,
        "<tr id=\"{name}\"><td>{name}</td><td><a download=\"{file}\" \
         href=\"data:application/octet-stream;base64,{}\">{file}</a>, {}</td><td>{x}×{y}×{z}</td>\
         <td>{}</td><td>{}</td></tr>",
        STANDARD.encode(info.spirv),
        bytes(info.spirv.len() as u64),
        escape(&buffers.join(", ")),
        escape(&params.join(", "))
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::check::{Bound, Outcome};
    use splat4d::vk::DeviceKind;

    fn device() -> Tested {
        let info = DeviceInfo {
            index: 1,
            name: "A <GPU>".into(),
            kind: DeviceKind::Discrete,
            driver: "maker's 1.2".into(),
            api_version: 1 << 22 | 3 << 12 | 9,
            subgroup_size: 32,
            memory_bytes: 3 << 30,
        };
        let limits = Limits {
            groups: 65_535,
            storage_range: 1 << 30,
            storage_alignment: 16,
            timestamp_period: 1.0,
        };
        Tested { info, limits, subgroup_sizes: vec![16, 32], profile: "gpu" }
    }

    fn row(of: &Tested, passed: bool) -> Row {
        let finding = Finding {
            output: "subgroups of 16: offsets <x>".into(),
            count: 10,
            bound: Some(Bound { absolute: 1e-6, relative: 0.0 }),
            worst_absolute: 0.5,
            worst_relative: 0.25,
            worst_ulp: None,
            worst_of_bound: if passed { 0.5 } else { 5e5 },
            worst_at: 7,
            got: "1.5".into(),
            expected: "2.0".into(),
            oracle_f32_absolute: None,
            oracle_f32_of_bound: Some(0.125),
            passed,
        };
        let dispatched = Dispatched { kernel: "sort/count", constants: vec![], profile: "gpu" };
        let outcome = Outcome {
            id: "sort/sizes",
            seed: 9,
            findings: vec![finding],
            dispatched: [dispatched].into(),
            error: None,
        };
        let said = if passed { vec![] } else { vec!["a hazard & more".to_owned()] };
        Row::new(&of.info, outcome, said, 0.5, &[])
    }

    #[test]
    fn a_failure_is_told_with_its_values_and_modules() {
        let devices = [device()];
        let rows = [row(&devices[0], false)];
        let options = [("Cases", "quick".to_owned())];
        let html = Page { devices: &devices, rows: &rows, options: &options }.html().unwrap();
        let module = kernels::ALL.iter().find(|info| info.name == "sort/count").unwrap();
        for part in [
            "1 of 1 cases failed",
            "A &lt;GPU&gt;",
            "maker&#39;s 1.2",
            "1.3.9",
            "16, 32",
            "splat4d validate --device 1 --filter sort/sizes --seed 9 --validation",
            "validation layer: a hazard &amp; more",
            "subgroups of 16: offsets &lt;x&gt;</td><td>7 of 10</td><td>2.0</td><td>1.5</td>",
            "500000.000",
            "0.125 times the bound",
            "href=\"#sort/count\"",
            "download=\"sort-count.spv\"",
            &STANDARD.encode(module.spirv),
        ] {
            assert!(html.contains(part), "{part}");
        }
        for part in ["<GPU>", "http:", "https:", "<script", "src=\""] {
            assert!(!html.contains(part), "{part}");
        }
    }

    #[test]
    fn without_a_failure_no_module_is_in_it() {
        let devices = [device()];
        let rows = [row(&devices[0], true)];
        let html = Page { devices: &devices, rows: &rows, options: &[] }.html().unwrap();
        assert!(html.contains("None of 1 cases failed") && html.contains("sort/sizes"), "{html}");
        assert!(!html.contains("octet-stream") && !html.contains("class=\"doubt\""), "{html}");
    }
}
