"""Types of the native part; its docstrings have shapes, units and errors."""

import builtins
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._gradients import Gradients
from ._page import Page

class Error(Exception): ...

class DeviceInfo:
    @property
    def index(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def driver(self) -> str: ...
    @property
    def memory_bytes(self) -> int: ...

class Device:
    def __new__(cls, selector: str = "best") -> Device: ...
    @staticmethod
    def list() -> builtins.list[DeviceInfo]: ...
    @property
    def info(self) -> DeviceInfo: ...
    @property
    def name(self) -> str: ...
    @property
    def memory(self) -> tuple[int, int]: ...

class Camera:
    def __new__(
        cls,
        width: int,
        height: int,
        *,
        fx: float,
        fy: float | None = None,
        cx: float | None = None,
        cy: float | None = None,
        view_from_world: ArrayLike | None = None,
        rotation: ArrayLike | None = None,
        translation: ArrayLike | None = None,
    ) -> Camera: ...
    @staticmethod
    def read(path: str | PathLike[str]) -> tuple[list[Camera], NDArray[np.float64]]: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def rotation(self) -> NDArray[np.float64]: ...
    @property
    def translation(self) -> NDArray[np.float64]: ...
    @property
    def view_from_world(self) -> NDArray[np.float64]: ...
    @property
    def centre(self) -> NDArray[np.float64]: ...
    def resized(self, width: int, height: int) -> Camera: ...

class Scene:
    def __new__(
        cls, *, background: Sequence[float] = (0.0, 0.0, 0.0), **arrays: ArrayLike
    ) -> Scene: ...
    @staticmethod
    def open(path: str | PathLike[str], *, drop_bad: bool = False) -> Scene: ...
    def save(self, path: str | PathLike[str]) -> None: ...
    def export(self, path: str | PathLike[str]) -> int: ...
    def show(self, *, height: int = 480, device: str = "best") -> Page: ...
    def _repr_html_(self) -> str: ...
    def arrays(self) -> dict[str, NDArray[np.float32]]: ...
    def set_arrays(self, **arrays: ArrayLike) -> None: ...
    def camera_path(
        self,
        shape: str = "orbit",
        *,
        frames: int = 60,
        time: float | None = None,
        size: tuple[int, int] | None = None,
        focal: float | None = None,
    ) -> tuple[list[Camera], NDArray[np.float64]]: ...
    def set_cameras(self, cameras: Sequence[Camera], times: ArrayLike) -> None: ...
    def __len__(self) -> int: ...
    @property
    def sh_degree(self) -> int: ...
    @property
    def moves(self) -> bool: ...
    @property
    def dropped(self) -> int: ...
    @property
    def background(self) -> list[float]: ...
    @background.setter
    def background(self, background: Sequence[float]) -> None: ...
    @property
    def blending(self) -> dict[str, float]: ...
    def set_blending(
        self,
        *,
        near: float = ...,
        dilation: float = ...,
        alpha_cut: float = ...,
        alpha_cap: float = ...,
        transmittance_stop: float = ...,
        tangent_clamp: float = ...,
    ) -> None: ...
    @property
    def up(self) -> list[float]: ...
    @property
    def cameras(self) -> list[Camera]: ...
    @property
    def times(self) -> NDArray[np.float64]: ...

class Rendered:
    @property
    def rgba(self) -> NDArray[np.float32]: ...
    @property
    def depth(self) -> NDArray[np.float32]: ...
    def over(self, background: Sequence[float] = (0.0, 0.0, 0.0)) -> NDArray[np.float32]: ...
    def mean_depth(self) -> NDArray[np.float32]: ...

class Renderer:
    def __new__(cls, device: Device, scene: Scene) -> Renderer: ...
    def render(self, camera: Camera, time: float = 0.0) -> Rendered: ...
    def moving(self, camera: Camera, time: float = 0.0) -> NDArray[np.float32]: ...
    def normals(self, camera: Camera, time: float = 0.0) -> NDArray[np.float32]: ...
    def __len__(self) -> int: ...

class View:
    def __new__(
        cls,
        image: ArrayLike,
        camera: Camera,
        time: float = 0.0,
        *,
        weights: ArrayLike | None = None,
        mask: ArrayLike | None = None,
    ) -> View: ...

class Progress:
    @property
    def step(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def gaussians(self) -> int: ...

class _Loss(TypedDict):
    l1: float
    ssim: float
    disparity: float

class Trainer:
    def __new__(
        cls,
        device: Device,
        scene: Scene,
        views: Sequence[View] = (),
        *,
        extent: float = 1.0,
        steps: int = 30000,
        growth: str | None = "mcmc",
        max_gaussians: int = 1000000,
        sh_degree: int = 3,
        sh_interval: int = ...,
        ssim_share: float = 0.2,
        background: Sequence[float] = ...,
        seed: int = 0,
        rigidity_weight: float = ...,
        position_rate: float = ...,
        position_rate_last: float = ...,
        log_scale_rate: float = ...,
        rotation_rate: float = ...,
        opacity_rate: float = ...,
        sh0_rate: float = ...,
        sh_rest_rate: float = ...,
    ) -> Trainer: ...
    def step(self) -> None: ...
    def steps(
        self, count: int, *, progress: Callable[[Progress], Any] | None = None
    ) -> None: ...
    @property
    def progress(self) -> Progress: ...
    def loss(self) -> _Loss | None: ...
    def psnr(self) -> float | None: ...
    def scene(self) -> Scene: ...
    def forward(self, camera: Camera, time: float = 0.0) -> Rendered: ...
    def backward(
        self, grad_rgba: ArrayLike, grad_depth: ArrayLike | None = None
    ) -> Gradients: ...
    def update(self) -> None: ...

def loss(
    device: Device,
    rgba: ArrayLike,
    image: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    ssim_share: float = 0.2,
) -> tuple[float, NDArray[np.float32]]: ...
def deform(
    device: Device,
    positions: ArrayLike,
    rotations: ArrayLike,
    opacity_logits: ArrayLike,
    control_positions: ArrayLike,
    control_log_radii: ArrayLike,
    motions: ArrayLike,
    *,
    neighbours: int = 4,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]: ...
def deform_backward(
    device: Device,
    grad_positions: ArrayLike,
    grad_rotations: ArrayLike,
    positions: ArrayLike,
    rotations: ArrayLike,
    opacity_logits: ArrayLike,
    control_positions: ArrayLike,
    control_log_radii: ArrayLike,
    motions: ArrayLike,
    *,
    neighbours: int = 4,
) -> dict[str, NDArray[np.float32]]: ...
def adam(
    device: Device,
    parameters: ArrayLike,
    gradients: ArrayLike,
    first: ArrayLike,
    second: ArrayLike,
    *,
    step: int,
    rate: float = 1e-3,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]: ...
def sort(
    device: Device,
    keys: ArrayLike,
    payload: ArrayLike | None = None,
    *,
    bits: tuple[int, int] = (0, 32),
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]: ...
