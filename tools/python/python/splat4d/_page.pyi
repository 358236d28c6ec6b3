"""Types of the page for notebooks."""

from dataclasses import dataclass
from os import PathLike

from ._splat4d import Scene

@dataclass(frozen=True, repr=False)
class Page:
    html: str
    height: int
    def save(self, path: str | PathLike[str]) -> None: ...
    def _repr_html_(self) -> str: ...

def show(scene: Scene, height: int, device: str) -> Page: ...
