//! Compute pipelines: the shader module, the layouts and the descriptor update template.

use super::device::Context;
use super::vk_error;
use crate::error::{Error, Result};
use ash::vk;
use std::sync::Arc;

/// The description of a pipeline to create.
pub(crate) struct PipelineShape<'a> {
    pub(crate) name: &'static str,
    pub(crate) spirv: &'a [u8],
    pub(crate) bindings: u32,
    pub(crate) push_bytes: u32,
    pub(crate) workgroup: [u32; 3],
    /// The subgroup size to require; `None`: the driver's default.
    pub(crate) subgroup: Option<u32>,
    /// Values of the specialisation constants 0, 1, …
    pub(crate) specialisation: &'a [u32],
}

/// A compute pipeline with one descriptor set of storage buffers.
pub(crate) struct Pipeline {
    pub(super) raw: vk::Pipeline,
    pub(super) layout: vk::PipelineLayout,
    pub(super) set_layout: vk::DescriptorSetLayout,
    pub(super) template: vk::DescriptorUpdateTemplate,
    pub(crate) name: &'static str,
    context: Arc<Context>,
}

impl Pipeline {
    pub(crate) fn new(context: &Arc<Context>, shape: &PipelineShape<'_>) -> Result<Pipeline> {
        // Filled step by step, so that `drop` destroys what exists if a step fails.
        let mut pipeline = Pipeline {
            raw: vk::Pipeline::null(),
            layout: vk::PipelineLayout::null(),
            set_layout: vk::DescriptorSetLayout::null(),
            template: vk::DescriptorUpdateTemplate::null(),
            name: shape.name,
            context: context.clone(),
        };
        pipeline.lay_out(shape)?;
        pipeline.make_template(shape)?;
        pipeline.compile(shape)?;
        Ok(pipeline)
    }

    /// Creates the layout of the descriptor set and that of the pipeline.
    fn lay_out(&mut self, shape: &PipelineShape<'_>) -> Result<()> {
        let device = &self.context.raw;
        let bindings: Vec<_> = (0..shape.bindings)
            .map(|binding| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(binding)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
        // SAFETY: the device is alive and the info points at locals.
        self.set_layout = unsafe { device.create_descriptor_set_layout(&info, None) }
            .map_err(vk_error("vkCreateDescriptorSetLayout"))?;

        let set_layouts = [self.set_layout];
        let push = [vk::PushConstantRange::default()
            .stage_flags(vk::ShaderStageFlags::COMPUTE)
            .size(shape.push_bytes)];
        let info = vk::PipelineLayoutCreateInfo::default()
            .set_layouts(&set_layouts)
            .push_constant_ranges(if shape.push_bytes > 0 { &push } else { &[] });
        // SAFETY: as above.
        self.layout = unsafe { device.create_pipeline_layout(&info, None) }
            .map_err(vk_error("vkCreatePipelineLayout"))?;
        Ok(())
    }

    /// Creates the template that fills a descriptor set; none for a kernel without bindings.
    fn make_template(&mut self, shape: &PipelineShape<'_>) -> Result<()> {
        if shape.bindings == 0 {
            return Ok(());
        }
        let stride = size_of::<vk::DescriptorBufferInfo>();
        let entry = vk::DescriptorUpdateTemplateEntry::default()
            .descriptor_count(1)
            .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
            .stride(stride);
        let entries: Vec<_> = (0..shape.bindings)
            .map(|binding| entry.dst_binding(binding).offset(binding as usize * stride))
            .collect();
        let info = vk::DescriptorUpdateTemplateCreateInfo::default()
            .descriptor_update_entries(&entries)
            .template_type(vk::DescriptorUpdateTemplateType::DESCRIPTOR_SET)
            .descriptor_set_layout(self.set_layout);
        // SAFETY: the device is alive and the info points at locals.
        self.template = unsafe { self.context.raw.create_descriptor_update_template(&info, None) }
            .map_err(vk_error("vkCreateDescriptorUpdateTemplate"))?;
        Ok(())
    }

    /// Compiles the kernel.
    fn compile(&mut self, shape: &PipelineShape<'_>) -> Result<()> {
        let context = &self.context;
        let device = &context.raw;
        let code = ash::util::read_spv(&mut std::io::Cursor::new(shape.spirv)).map_err(|e| {
            Error::Unsupported { kernel: shape.name.into(), missing: format!("valid SPIR-V: {e}") }
        })?;
        let info = vk::ShaderModuleCreateInfo::default().code(&code);
        // SAFETY: the module was compiled by `tools`, and its interface is checked against the
        // kernel's declaration by `tests/interface.rs`.
        let module = unsafe { device.create_shader_module(&info, None) }
            .map_err(vk_error("vkCreateShaderModule"))?;
        let entries: Vec<_> = (0..shape.specialisation.len() as u32)
            .map(|id| vk::SpecializationMapEntry { constant_id: id, offset: id * 4, size: 4 })
            .collect();
        let specialisation = vk::SpecializationInfo::default()
            .map_entries(&entries)
            .data(bytemuck::cast_slice(shape.specialisation));
        // Vulkan allows the full-subgroups flag only if the workgroup's width is a multiple of the
        // subgroup size.
        let largest = shape.subgroup.unwrap_or(context.max_subgroup);
        let full = match shape.workgroup[0] % largest {
            0 => vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS,
            _ => vk::PipelineShaderStageCreateFlags::empty(),
        };
        let mut required = vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default()
            .required_subgroup_size(largest);
        let mut stage = vk::PipelineShaderStageCreateInfo::default()
            .flags(full)
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(module)
            .name(c"main")
            .specialization_info(&specialisation);
        if shape.subgroup.is_some() {
            stage = stage.push_next(&mut required);
        }
        let info = [vk::ComputePipelineCreateInfo::default().stage(stage).layout(self.layout)];
        // SAFETY: the device is alive and the infos point at locals.
        let created = unsafe { device.create_compute_pipelines(context.cache.raw, &info, None) };
        // SAFETY: the pipeline has its own copy.
        unsafe { device.destroy_shader_module(module, None) };
        let created =
            created.map_err(|(_, result)| vk_error("vkCreateComputePipelines")(result))?;
        self.raw = created[0];
        if self.raw == vk::Pipeline::null() {
            // Some drivers report success but return no pipeline for SPIR-V that they cannot
            // compile.
            return Err(Error::Unsupported {
                kernel: shape.name.into(),
                missing: "the driver did not compile the kernel".into(),
            });
        }
        Ok(())
    }
}

impl Drop for Pipeline {
    fn drop(&mut self) {
        let device = &self.context.raw;
        // SAFETY: submissions in flight hold an `Arc` of every pipeline they use; null handles are
        // legal to destroy.
        unsafe {
            device.destroy_pipeline(self.raw, None);
            device.destroy_descriptor_update_template(self.template, None);
            device.destroy_pipeline_layout(self.layout, None);
            device.destroy_descriptor_set_layout(self.set_layout, None);
        }
    }
}
