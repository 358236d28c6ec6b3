"""The page that a notebook shows."""

import re
from html.parser import HTMLParser

import pytest

import splat4d
from conftest import gaussians, moving_arrays


class Elements(HTMLParser):
    """The elements of an HTML text with their attributes, and the text outside of them."""

    def __init__(self, text):
        super().__init__()
        self.found, self.text = [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("arrays", [gaussians(30, degree=1), moving_arrays()])
def test_a_scene_is_shown_by_the_page_that_export_writes(tmp_path, camera, arrays):
    scene = splat4d.Scene(**arrays)
    scene.set_cameras([camera], [0.25])
    scene.save(tmp_path / "scene.safetensors")
    page = scene.show(height=300, device="software")
    told = splat4d.command(
        "export", tmp_path / "scene.safetensors", output=tmp_path / "scene.html", device="software",
        progress=lambda line: None,
    )
    assert told["format"] == "html"
    written = (tmp_path / "scene.html").read_bytes().decode()
    assert page.html == written and "<title>scene</title>" in written
    page.save(tmp_path / "saved.html")
    assert (tmp_path / "saved.html").read_bytes().decode() == written

    # One frame that holds the whole page and nothing else, in whatever document it stands.
    elements = Elements(f"<p>{page._repr_html_()}</p>")
    assert [tag for tag, _ in elements.found] == ["p", "iframe"] and not elements.text
    frame = elements.found[1][1]
    assert frame["srcdoc"] == written
    assert "height:300px" in frame["style"] and "src" not in frame
    # A notebook loads nothing from elsewhere for it.
    inner = Elements(written)
    loading = [attributes.get("src") or attributes.get("href") for _, attributes in inner.found]
    assert set(filter(None, loading)) == {"data:,"}
    assert not re.search(r"<script[^>]*\bsrc=", written)


def test_a_scene_itself_is_shown_in_a_cell(camera):
    scene = splat4d.Scene(**gaussians(5))
    scene.set_cameras([camera], [0.0])
    assert scene._repr_html_() == scene.show()._repr_html_()
    assert re.fullmatch(r"<splat4d.Page: [\d,]+ characters of HTML>", repr(scene.show()))


def test_what_cannot_be_shown_says_so():
    with pytest.raises(splat4d.Error, match="no such device"):
        splat4d.Scene(**moving_arrays()).show(device="no such device")
