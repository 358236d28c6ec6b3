"""The interactive page of a scene, for notebooks."""

import os
import tempfile
from dataclasses import dataclass
from html import escape
from pathlib import Path

from ._program import command


@dataclass(frozen=True, repr=False)
class Page:
    """The interactive page of a scene: the file that `splat4d export SCENE -o FILE.html` writes. It plays in any
    browser with WebGL 2 and loads nothing from elsewhere. A notebook shows it in a cell, `height` CSS pixels high.

    `html` is the text of the page."""

    html: str
    height: int

    def save(self, path):
        """Writes the page to a file."""
        Path(path).write_bytes(self.html.encode())

    def _repr_html_(self):
        # The frame's document has a policy, scripts and styles of its own, which the notebook's do not meet.
        return (
            f'<iframe srcdoc="{escape(self.html)}" title="splat4d scene" allow="fullscreen" '
            f'style="display:block;width:100%;height:{self.height}px;border:0"></iframe>'
        )

    def __repr__(self):
        return f"<splat4d.Page: {len(self.html):,} characters of HTML>"


def show(scene, height, device):
    """The page of a scene; `Scene.show` has the documentation."""
    with tempfile.TemporaryDirectory(prefix="splat4d-") as folder:
        # The page's title is the name of the file.
        file, page = os.path.join(folder, "scene.safetensors"), os.path.join(folder, "scene.html")
        scene.save(file)
        command("export", file, output=page, device=device, progress=lambda line: None)
        return Page(Path(page).read_bytes().decode(), height)
