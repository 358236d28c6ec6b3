//! splat4d: a Vulkan compute engine that turns one ordinary video of a moving scene, camera poses
//! unknown, into a 4D Gaussian-splat scene that renders in real time.
//!
//! # Data flow
//!
//! ```text
//! video ─> observe ─> track ─> seed ─> train ─> scene ─> render · evaluate
//!          │          │        │       └ stage 1: control points; stage 2: Gaussians
//!          │          │        └ static and dynamic Gaussians, control points
//!          │          └ motion-aware bundle adjustment: intrinsics, poses, depth, motion masks
//!          └ per frame: optical flow, depth, motion
//! ```
//!
//! A dataset whose cameras are known ([`data::Dataset`]) enters at *seed*.
//!
//! # The parts
//!
//! A part may name what is listed with it under *sees*, and nothing else; `tests/interface.rs` reads
//! the source and fails on a breach.
//!
//! | part | what it is | sees |
//! |---|---|---|
//! | [`error`] | the one error: what was wrong, where, what to do | |
//! | [`types`] | plain data: cameras, Gaussians, control points, images | |
//! | [`io`] | whole-file reads, writes by rename, the PLY container | |
//! | [`vk`] | Vulkan: with `embed` and `capi` the only place with `unsafe` and the name `ash` | |
//! | [`gpu`] | the safe layer: devices, typed buffers, the recorder, the stream | vk |
//! | [`embed`] | hosts: their device, command buffers, memory, semaphores | vk, gpu |
//! | [`kernels`] | the declaration of every shader | types, gpu |
//! | [`oracle`] | the CPU twin of every kernel, generic over f32 and f64; no Vulkan | types |
//! | [`ops`] | algorithms of many dispatches: scan, sort, render, loss, deformation, Adam | types, gpu, kernels |
//! | [`geometry`] | SE(3), Sim(3), two-view geometry, PnP, bundle adjustment, in f64 | types |
//! | [`scene`] | the 4D scene and its files | types, io |
//! | [`camera_path`] | cameras on a path around a scene: views that the input did not have | types, geometry, scene |
//! | [`data`] | readers of videos and datasets; synthetic clips with exact truth | types, io |
//! | [`eval`] | PSNR, SSIM, MS-SSIM, ATE, RPE | types, io, geometry |
//! | [`train`] | seeding, the training step, schedules | all of the above but vk, kernels, oracle |
//! | [`renderer`] | a scene on a device, rendered from any camera at any time | gpu, ops, scene |
//! | [`view`] | a scene in the browser: the page and what serves it (feature `view`) | types, io, gpu, data, scene, renderer |
//! | `capi` | the engine in C, `include/splat4d.h` (feature `capi`) | gpu, embed, ops, scene, renderer, train |
//! | [`check`] | cases: every kernel against its oracle, pose estimation on its hard cases, training twice | all of the above but vk |
//! | `report` | measurements: JSON, CSV, plots, a page, comparisons (feature `bench`) | io |
//! | `bench` | every op and pipeline, verified, then timed; speed against error (feature `bench`) | all of the above |
//!
//! The command line (`src/main.rs`, `src/cmd/`) uses the crate as any other user does.
//!
//! # Features
//!
//! Each holds the one before. Without any, the crate is the engine alone: devices, kernels, ops, the
//! renderer and the trainer's step; scenes are plain data, and no file is read or written.
//!
//! | feature | adds |
//! |---|---|
//! | `files` | [`io`], [`data`], the scene's files; a cache of compiled pipelines |
//! | `reconstruct` | [`geometry`], [`camera_path`], [`observe`], [`track`], [`eval`], whole runs of [`train`] |
//! | `check` | [`oracle`], [`check`] |
//! | `bench` | `bench`, `report` |
//! | `cli` (default) | the command line |
//!
//! Beside these, `onnx` (in `cli`, on top of `reconstruct`) runs networks through an ONNX Runtime, which is
//! found when one is asked for, `view` (in `cli`, on top of `files`) shows scenes in a browser, and `capi` adds the C interface, on top of the engine alone or of `files`.
//!
//! # Stability
//!
//! Before 1.0 a minor version may change the interface; `CHANGELOG.md` says so. `tests/api/public.txt` lists what
//! is promised within a minor version. [`kernels`], [`oracle`], [`check`], `bench` and `report` are public for tests
//! and tools and promise nothing. Structs of settings and options may gain fields: set those that matter, and
//! take the others from [`Default`] or from the preset that made the value.
//!
//! # Conventions
//!
//! Those of [`types`]. The working precision of the device is f32; the oracle in f64 is the truth.
//! Nothing adds floats atomically, so that the same input, device and driver give the same bits.
//!
//! # Glossary
//!
//! | term | meaning |
//! |---|---|
//! | frame | one time step of the input clip, with its image and camera |
//! | training view | a posed image that is trained on ([`train::TrainingView`]) |
//! | splat | a Gaussian after projection into one image |
//! | intersection, pair | one (splat, tile) entry of the binning |
//! | capacity | how many elements the buffers hold; a frame that needs more is repeated with a larger capacity |
//! | control point, node | a point with a path of rigid motions that the Gaussians near it follow (linear blend skinning); `node` in identifiers |
//! | mover | an object that moves relative to the static world |
//! | scaffold | the tracks of the control points through all frames, before training |
//! | lifting | finding the depth of a tracked 2D point |
//! | background plate | what a frame would show without movers |
//! | offset view | a render target seen from a camera beside the input's path, made from the input's frames and depth |
//! | seed | the first Gaussians, before training |
//! | oracle | the CPU reference in f64 that defines the correct result |
//! | twin | the CPU implementation of one kernel, generic over f32 and f64 |
//! | case | one test of a kernel or pipeline against its oracle, which tests and `validate` run |
//! | profile | the variants of kernels and the sizes of work that suit a kind of device ([`gpu::Profile`]) |
//! | rehearsal | running the planning code without device memory, to find how much it would take |
//! | scalar tail | the elements left over after the last whole vector load |
//!
//! # Example
//!
//! Rendering a scene from its first camera:
//!
//! ```no_run
//! use splat4d::{data::write_png, gpu::Device, renderer::Renderer, scene::Scene};
//!
//! fn main() -> splat4d::Result<()> {
//!     let scene = Scene::open("scene.safetensors", false)?.scene;
//!     let device = Device::open(&Default::default())?;
//!     let mut renderer = Renderer::new(&device, &scene)?;
//!     let first = &scene.cameras[0];
//!     let rendered = renderer.render(&first.camera, first.time)?;
//!     write_png("first.png", &rendered.over(scene.background))
//! }
//! ```
#![deny(unsafe_code)]

#[cfg(feature = "bench")]
pub mod bench;
#[cfg(feature = "reconstruct")]
pub mod camera_path;
#[cfg(feature = "capi")]
pub mod capi;
#[cfg(feature = "check")]
pub mod check;
#[cfg(feature = "files")]
pub mod data;
pub mod embed;
pub mod error;
#[cfg(feature = "reconstruct")]
pub mod eval;
#[cfg(feature = "reconstruct")]
pub mod geometry;
pub mod gpu;
#[cfg(feature = "files")]
pub mod io;
pub mod kernels;
#[cfg(feature = "reconstruct")]
pub mod observe;
pub mod ops;
#[cfg(feature = "check")]
pub mod oracle;
pub mod renderer;
#[cfg(feature = "bench")]
pub mod report;
pub mod scene;
#[cfg(feature = "reconstruct")]
#[allow(clippy::too_many_arguments, reason = "four functions take the clip's parts one by one")]
pub mod track;
pub mod train;
pub mod types;
#[cfg(feature = "view")]
pub mod view;
pub mod vk;

pub use error::{Error, Result};

/// The README's example compiles.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
