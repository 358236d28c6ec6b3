"""Types of the function with gsplat's interface."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._splat4d import Device

def rasterization(
    means: ArrayLike,
    quats: ArrayLike,
    scales: ArrayLike,
    opacities: ArrayLike,
    colors: ArrayLike,
    viewmats: ArrayLike,
    Ks: ArrayLike,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: ArrayLike | None = None,
    render_mode: str = "RGB",
    channel_chunk: int = 32,
    *,
    device: Device | None = None,
    **others: Any,
) -> tuple[NDArray[np.float32], NDArray[np.float32], dict[str, Any]]: ...
