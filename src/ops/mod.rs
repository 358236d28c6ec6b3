//! Algorithms of several dispatches.
//!
//! Each op has three steps: `plan` fixes the sizes, `scratch` allocates what lies between the
//! dispatches, `record` records them. No op allocates, submits or waits in `record`. The documentation
//! of `record` lists the dispatches in order: a profiled recording has a time for each.

pub mod adam;
pub mod arap;
pub mod deform;
pub mod density;
pub mod flow;
pub mod gaussians;
pub mod half;
pub mod loss;
pub mod mask;
pub mod mlp;
pub mod motion;
pub mod neighbours;
pub mod render;
pub mod scan;
pub mod sort;
pub mod texel;

use crate::{Error, Result};

/// Checks that every argument, given as name, elements needed and elements there, is long enough.
fn at_least(op: &'static str, shapes: &[(&'static str, usize, usize)]) -> Result<()> {
    match shapes.iter().find(|(_, needed, actual)| actual < needed) {
        None => Ok(()),
        Some(&(arg, needed, actual)) => {
            Err(Error::Shape { op, arg, expected: format!("at least {needed}"), actual })
        }
    }
}
