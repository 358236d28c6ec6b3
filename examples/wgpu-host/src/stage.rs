//! The host's rendering resources, and the recording of a frame:
//!
//! 1. wgpu transitions the splats' texture to the state of a copy destination;
//! 2. the engine records the splats and the copy into the texture, in one of wgpu's command encoders;
//! 3. wgpu draws the triangle, and then the splats' texture over it.
//!
//! wgpu submits the three command buffers together, in this order. wgpu does not track the engine's
//! commands and does not need to: its own state tracking has the texture as a copy destination at the end
//! of step 1 and at the start of step 3, which matches step 2, and the engine adds barriers against all
//! commands before and after its own. wgpu encodes its commands with a delay, so commands recorded without
//! its knowledge need a separate encoder.

use crate::Result;
use crate::gpu::Gpu;
use splat4d::embed::ash::vk;
use splat4d::embed::{Guard, HostImage};
use splat4d::gpu::Recorder;
use splat4d::renderer::{Frame, Renderer, Target};
use splat4d::scene::Scene;
use splat4d::types::Camera;
use std::collections::VecDeque;
use std::iter;
use std::time::{Duration, Instant};
use wgpu::hal::api::Vulkan;

/// Frame size, pixels. Powers of two, so that the triangle's corners lie exactly on pixel corners; rows of
/// texels are multiples of 256 bytes, as wgpu's copies require.
pub const WIDTH: u32 = 512;
pub const HEIGHT: u32 = 256;
const SIZE: wgpu::Extent3d =
    wgpu::Extent3d { width: WIDTH, height: HEIGHT, depth_or_array_layers: 1 };

/// Colours with eight bits per channel, as in a window.
pub const BACKGROUND: [u8; 4] = [24, 28, 36, 255];
pub const TRIANGLE: [u8; 4] = [51, 102, 204, 255];
/// The triangle's corners, pixels from the upper left. The ball overlaps the right-hand corner.
pub const CORNERS: [[f32; 2]; 3] = [[340.0, 190.0], [150.0, 30.0], [40.0, 230.0]];

pub struct Stage {
    gpu: Gpu,
    renderer: Renderer,
    /// The engine's rendered image, 32-bit floats.
    splats: wgpu::Texture,
    /// The host's frame, as it would be displayed.
    frame: wgpu::Texture,
    corners: wgpu::Buffer,
    triangle: wgpu::RenderPipeline,
    over: wgpu::RenderPipeline,
    binding: wgpu::BindGroup,
    in_flight: VecDeque<InFlight>,
}

/// The objects that a frame uses until the device has finished it.
struct InFlight {
    submission: wgpu::SubmissionIndex,
    guard: Guard,
    frame: Frame,
}

/// Time that the host thread spent on a frame.
#[derive(Clone, Copy, Default)]
pub struct HostTime {
    /// In the engine: recording of the splats and their copy.
    pub record: Duration,
    /// In wgpu: encoding of wgpu's commands.
    pub encode: Duration,
    /// In wgpu: the submission.
    pub submit: Duration,
}

/// Time spent on retiring frames.
#[derive(Clone, Copy, Default)]
pub struct Settled {
    /// Time waited for the device, because the maximum number of frames was in flight.
    pub wait: Duration,
    /// Time spent in the engine.
    pub retire: Duration,
    /// Number of frames whose splats exceeded the capacity, so that some are missing.
    pub cut: usize,
}

impl Stage {
    pub fn new(gpu: Gpu, scene: &Scene) -> Result<Stage> {
        let device = &gpu.device;
        let texture = |label, format, usage| {
            device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: SIZE,
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: usage | wgpu::TextureUsages::COPY_SRC,
                view_formats: &[],
            })
        };
        let splats = texture(
            "splats",
            wgpu::TextureFormat::Rgba32Float,
            wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::TEXTURE_BINDING,
        );
        let frame = texture(
            "frame",
            wgpu::TextureFormat::Rgba8Unorm,
            wgpu::TextureUsages::RENDER_ATTACHMENT,
        );
        let corners = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("corners"),
            size: size_of_val(&CORNERS) as u64,
            usage: wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let clip =
            CORNERS.map(|[x, y]| [2.0 * x / WIDTH as f32 - 1.0, 1.0 - 2.0 * y / HEIGHT as f32]);
        gpu.queue.write_buffer(&corners, 0, bytemuck::cast_slice(&clip));
        // wgpu clears a texture before its first use unless it has tracked a write to it, and it does not
        // track the engine's copies. This write prevents the clear.
        let zeros = vec![0; (WIDTH * HEIGHT * 16) as usize];
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(WIDTH * 16),
            rows_per_image: None,
        };
        gpu.queue.write_texture(splats.as_image_copy(), &zeros, layout, SIZE);

        let shaders = device.create_shader_module(wgpu::include_wgsl!("stage.wgsl"));
        let bindings = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: None,
            entries: &[wgpu::BindGroupLayoutEntry {
                binding: 0,
                visibility: wgpu::ShaderStages::FRAGMENT,
                ty: wgpu::BindingType::Texture {
                    sample_type: wgpu::TextureSampleType::Float { filterable: false },
                    view_dimension: wgpu::TextureViewDimension::D2,
                    multisampled: false,
                },
                count: None,
            }],
        });
        let view = splats.create_view(&Default::default());
        let binding = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &bindings,
            entries: &[wgpu::BindGroupEntry {
                binding: 0,
                resource: wgpu::BindingResource::TextureView(&view),
            }],
        });
        let pipeline = |vertex, fragment, layouts: &[_], buffers: &[_], blend| {
            let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                bind_group_layouts: layouts,
                ..Default::default()
            });
            device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: Some(fragment),
                layout: Some(&layout),
                vertex: wgpu::VertexState {
                    module: &shaders,
                    entry_point: Some(vertex),
                    compilation_options: Default::default(),
                    buffers,
                },
                primitive: Default::default(),
                depth_stencil: None,
                multisample: Default::default(),
                fragment: Some(wgpu::FragmentState {
                    module: &shaders,
                    entry_point: Some(fragment),
                    compilation_options: Default::default(),
                    targets: &[Some(wgpu::ColorTargetState {
                        format: frame.format(),
                        blend,
                        write_mask: wgpu::ColorWrites::ALL,
                    })],
                }),
                multiview_mask: None,
                cache: None,
            })
        };
        let vertices = wgpu::VertexBufferLayout {
            array_stride: size_of_val(&CORNERS[0]) as u64,
            step_mode: wgpu::VertexStepMode::Vertex,
            attributes: &wgpu::vertex_attr_array![0 => Float32x2],
        };
        let triangle = pipeline("corner", "plain", &[], &[Some(vertices)], None);
        let premultiplied = Some(wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING);
        let over = pipeline("everywhere", "over", &[Some(&bindings)], &[], premultiplied);

        // Uploads the scene through the queue.
        let mut renderer = Renderer::new(&gpu.engine, scene)?;
        // Compiles the kernels and allocates capacity once, before the first frame.
        renderer.render(&crate::scene::camera(0), 0.0)?;
        let in_flight = VecDeque::new();
        Ok(Stage { gpu, renderer, splats, frame, corners, triangle, over, binding, in_flight })
    }

    pub fn engine(&self) -> &splat4d::gpu::Device {
        &self.gpu.engine
    }

    pub fn splats(&self) -> &wgpu::Texture {
        &self.splats
    }

    pub fn frame(&self) -> &wgpu::Texture {
        &self.frame
    }

    /// Draws a frame and submits it to the queue. Never waits for the device.
    pub fn draw(&mut self, camera: &Camera) -> Result<HostTime> {
        let start = Instant::now();
        let device = &self.gpu.device;
        let mut before = device.create_command_encoder(&Default::default());
        before.transition_resources(
            iter::empty(),
            iter::once(wgpu::TextureTransition {
                texture: &self.splats,
                selector: None,
                state: wgpu::TextureUses::COPY_DST,
            }),
        );
        let mut splats = device.create_command_encoder(&Default::default());
        let mut after = device.create_command_encoder(&Default::default());
        self.show(&mut after);
        let (before, after) = (before.finish(), after.finish());
        let encode = start.elapsed();

        let start = Instant::now();
        // SAFETY: wgpu records no commands into this encoder, and ends it in `finish`.
        let recorded = unsafe {
            splats.as_hal_mut::<Vulkan, _, _>(|encoder| {
                let encoder = encoder.ok_or("the command encoder is not Vulkan's")?;
                self.record(encoder.raw_handle(), camera)
            })
        };
        let (frame, guard) = recorded?;
        let record = start.elapsed();

        let start = Instant::now();
        let splats = splats.finish();
        let submission = {
            let _turn = self.gpu.turn.lock().unwrap();
            self.gpu.queue.submit([before, splats, after])
        };
        let submit = start.elapsed();
        self.in_flight.push_back(InFlight { submission, guard, frame });
        Ok(HostTime { record, encode, submit })
    }

    /// Records the splats and their copy into the host's texture.
    ///
    /// # Safety
    /// `commands` must be the command buffer of a wgpu encoder that has begun and is otherwise empty.
    unsafe fn record(
        &mut self,
        commands: vk::CommandBuffer,
        camera: &Camera,
    ) -> Result<(Frame, Guard)> {
        // SAFETY: the caller guarantees the command buffer's state; it is submitted once, in `draw`, in the
        // order of recording; the guard lives until `settle` has waited for the submission.
        let mut recorder = unsafe { Recorder::over(&self.gpu.engine, commands) }?;
        let frame = self.renderer.record(&mut recorder, camera, 0.0, Target::default())?;
        // SAFETY: the guard is dropped before the texture, and nothing is destroyed through it.
        let texture = unsafe { self.splats.as_hal::<Vulkan>() }.ok_or("no texture of Vulkan's")?;
        let image = HostImage {
            // SAFETY: as above.
            image: unsafe { texture.raw_handle() },
            // The layout that wgpu uses for COPY_DST.
            layout: vk::ImageLayout::TRANSFER_DST_OPTIMAL,
            mip_level: 0,
            array_layer: 0,
            offset: [0, 0],
        };
        let picture = self.renderer.pixels().expect("just recorded").rgba.view();
        // SAFETY: the image belongs to this device, has the rendered image's size and texels of four floats,
        // and is in that layout since the previous encoder; it outlives the device's work on it.
        unsafe { recorder.copy_to_image(picture, &image, WIDTH, HEIGHT) }?;
        Ok((frame, recorder.finish()?))
    }

    /// Records the host's render pass: the triangle, then the splats over it.
    fn show(&self, encoder: &mut wgpu::CommandEncoder) {
        let view = self.frame.create_view(&Default::default());
        let [r, g, b, a] = BACKGROUND.map(|channel| f64::from(channel) / 255.0);
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color { r, g, b, a }),
                    store: wgpu::StoreOp::Store,
                },
            })],
            ..Default::default()
        });
        pass.set_pipeline(&self.triangle);
        pass.set_vertex_buffer(0, self.corners.slice(..));
        pass.draw(0..3, 0..1);
        pass.set_pipeline(&self.over);
        pass.set_bind_group(0, &self.binding, &[]);
        pass.draw(0..3, 0..1);
    }

    /// Waits until at most `most` frames are in flight, and retires the finished ones.
    pub fn settle(&mut self, most: usize) -> Result<Settled> {
        let mut settled = Settled::default();
        while self.in_flight.len() > most {
            let InFlight { submission, guard, frame } =
                self.in_flight.pop_front().expect("more than some");
            let start = Instant::now();
            self.gpu
                .device
                .poll(wgpu::PollType::Wait { submission_index: Some(submission), timeout: None })?;
            settled.wait += start.elapsed();
            let start = Instant::now();
            drop(guard);
            settled.cut += usize::from(!self.renderer.retire(frame)?.is_whole());
            settled.retire += start.elapsed();
        }
        Ok(settled)
    }

    /// Draws a frame and waits for it. Repeats this if the splats exceeded the capacity, which has been
    /// raised by then.
    pub fn draw_whole(&mut self, camera: &Camera) -> Result<()> {
        self.settle(0)?;
        loop {
            self.draw(camera)?;
            if self.settle(0)?.cut == 0 {
                return Ok(());
            }
        }
    }

    /// The texels of one of the two textures, row by row, after everything submitted has finished.
    pub fn read(&self, texture: &wgpu::Texture) -> Result<Vec<u8>> {
        let texel = texture.format().block_copy_size(None).expect("a plain format");
        let buffer = self.gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("readback"),
            size: u64::from(WIDTH * HEIGHT * texel),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        encoder.copy_texture_to_buffer(
            texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &buffer,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(WIDTH * texel),
                    rows_per_image: None,
                },
            },
            SIZE,
        );
        {
            let _turn = self.gpu.turn.lock().unwrap();
            self.gpu.queue.submit([encoder.finish()]);
        }
        let (tell, told) = std::sync::mpsc::channel();
        buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| {
            let _ = tell.send(result);
        });
        self.gpu.device.poll(wgpu::PollType::wait_indefinitely())?;
        told.recv()??;
        let bytes = buffer.slice(..).get_mapped_range()?.to_vec();
        buffer.unmap();
        Ok(bytes)
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // The objects that a frame uses must outlive it. Errors are ignored: a lost device no longer uses
        // them.
        let _ = self.settle(0);
    }
}
