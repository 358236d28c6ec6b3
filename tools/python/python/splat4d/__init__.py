"""splat4d: a Vulkan compute engine that trains and renders 4D Gaussian-splat scenes.

Camera axes are OpenCV's: x right, y down, z forward. Transforms are named ``a_from_b`` and map a
point of b to a. Pixel centres lie at +0.5. Quaternions are (w, x, y, z). Scales are stored as
natural logarithms, opacity and motion as logits. Colours are the image's own encoded values in
[0, 1]. Times are in [0, 1].
"""

from . import ops
from ._gradients import Gradients
from ._page import Page
from ._program import command, evaluate, reconstruct, synth, track, train
from ._rasterization import rasterization
from ._splat4d import (
    Camera,
    Device,
    DeviceInfo,
    Error,
    Progress,
    Rendered,
    Renderer,
    Scene,
    Trainer,
    View,
)

__all__ = [
    "Camera",
    "Device",
    "DeviceInfo",
    "Error",
    "Gradients",
    "Page",
    "Progress",
    "Rendered",
    "Renderer",
    "Scene",
    "Trainer",
    "View",
    "command",
    "evaluate",
    "ops",
    "rasterization",
    "reconstruct",
    "synth",
    "track",
    "train",
]
