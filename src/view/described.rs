//! `scene.json`, the description of the scene for the page, and the input images that it counts.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::protocol::Description;
use super::{MOST_LIVE_PIXELS, MOST_PIXELS, MOST_SIDE, Pictures, Show};
use crate::types::{Camera, Intrinsics, Pose};
use crate::{Error, Result};

/// What is served about the scene; replaced whenever a training hands over a scene.
#[derive(Clone)]
pub struct Described(Arc<Mutex<Served>>);

#[derive(Clone)]
struct Served {
    text: Arc<str>,
    pictures: Pictures,
}

impl Described {
    /// Makes the description and the images to be served.
    ///
    /// # Errors
    /// A number is not representable in JSON.
    pub fn new(description: &Description, pictures: Pictures) -> Result<Described> {
        Ok(Described(Arc::new(Mutex::new(Served::new(description, pictures)?))))
    }

    /// Replaces the description and the images.
    ///
    /// # Errors
    /// Those of [`new`](Self::new).
    pub fn set(&self, description: &Description, pictures: Pictures) -> Result<()> {
        *self.lock() = Served::new(description, pictures)?;
        Ok(())
    }

    /// The current description.
    pub fn text(&self) -> Arc<str> {
        self.lock().text.clone()
    }

    /// The current images.
    pub fn pictures(&self) -> Pictures {
        self.lock().pictures.clone()
    }

    fn lock(&self) -> MutexGuard<'_, Served> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Served {
    fn new(description: &Description, pictures: Pictures) -> Result<Served> {
        let text = serde_json::to_string(description);
        let text = text.map(Arc::from).map_err(|error| Error::Failed(error.to_string()))?;
        Ok(Served { text, pictures })
    }
}

/// The description of a scene; `live` while it is being trained.
pub fn of(device: &str, show: &Show, live: bool) -> Description {
    let scene = &show.scene;
    Description {
        name: show.name.clone(),
        device: device.to_owned(),
        gaussians: scene.gaussians.len(),
        moves: scene.moves(),
        control_points: if scene.moves() { scene.control_points.len() } else { 0 },
        up: scene.up,
        start: show.start.into(),
        distance: show.distance,
        cameras: scene.cameras.iter().map(Into::into).collect(),
        pictures: show.pictures.as_ref().map_or(0, |pictures| pictures.len()),
        most_side: MOST_SIDE,
        most_pixels: if live { MOST_LIVE_PIXELS } else { MOST_PIXELS },
        live,
    }
}

/// The description of a training that has no scene yet.
pub fn nothing(device: &str, name: &str) -> Description {
    let intrinsics = Intrinsics::centred(1.0, 1, 1);
    Description {
        name: name.to_owned(),
        device: device.to_owned(),
        gaussians: 0,
        moves: false,
        control_points: 0,
        up: [0.0, -1.0, 0.0],
        start: Camera { intrinsics, view_from_world: Pose::IDENTITY }.into(),
        distance: 1.0,
        cameras: Vec::new(),
        pictures: 0,
        most_side: MOST_SIDE,
        most_pixels: MOST_LIVE_PIXELS,
        live: true,
    }
}
