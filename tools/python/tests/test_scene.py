"""Cameras and scenes: arrays, files, errors."""

import numpy as np
import pytest

import splat4d
from conftest import gaussians, moving_arrays


def test_arrays_are_read_back_bit_for_bit(tmp_path, camera):
    given = {**gaussians(50, degree=2), **{
        "motion_logits": np.linspace(-1, 1, 50),
        "control_positions": np.random.default_rng(1).normal(size=(3, 3)),
        "control_log_radii": [-1, -1.5, -2],
        "control_paths": 0.1 * np.random.default_rng(2).normal(size=(4, 3, 8)),
    }}
    scene = splat4d.Scene(background=(0.25, 0.5, 1.0), **given)
    scene.set_cameras([camera, camera.resized(130, 98)], [0.0, 0.75])
    path = tmp_path / "scene.safetensors"
    scene.save(path)
    opened = splat4d.Scene.open(path)
    for other in (scene, opened):
        arrays = other.arrays()
        assert set(arrays) == set(given)
        for name, value in given.items():
            assert arrays[name].dtype == np.float32, name
            np.testing.assert_array_equal(arrays[name], np.asarray(value, np.float32), name)
        assert len(other) == 50 and other.sh_degree == 2 and other.moves
        assert other.background == [0.25, 0.5, 1.0]
        assert other.cameras == [camera, camera.resized(130, 98)]
        np.testing.assert_array_equal(other.times, [0.0, 0.75])
    assert opened.up == scene.up == [0.0, -1.0, 0.0]


def test_other_formats_hold_the_gaussians(tmp_path):
    scene = splat4d.Scene(**gaussians(20, degree=1))
    assert scene.export(tmp_path / "scene.ply") == 20
    arrays, read = scene.arrays(), splat4d.Scene.open(tmp_path / "scene.ply").arrays()
    for name in ("positions", "log_scales", "rotations", "opacity_logits", "sh"):
        np.testing.assert_array_equal(read[name], arrays[name], name)
    with pytest.raises(ValueError, match="scene.txt: expected a name that ends with .ply"):
        scene.export(tmp_path / "scene.txt")


def test_arrays_are_copies_and_a_failed_change_changes_nothing():
    scene = splat4d.Scene(**gaussians(4))
    before = scene.arrays()
    scene.arrays()["positions"][:] = 0
    with pytest.raises(ValueError, match="sh: expected 4 rows as in positions, got 3"):
        scene.set_arrays(opacity_logits=np.zeros(4), sh=np.zeros((3, 1, 3)))
    with pytest.raises(splat4d.Error, match="Gaussian 2: opacity logit"):
        scene.set_arrays(opacity_logits=[0, 0, np.nan, 0])
    for name, value in scene.arrays().items():
        np.testing.assert_array_equal(value, before[name], name)
    scene.set_arrays(opacity_logits=np.arange(8, dtype=np.int64)[::2])
    np.testing.assert_array_equal(scene.arrays()["opacity_logits"], [0, 2, 4, 6])


@pytest.mark.parametrize("name, value, text", [
    ("positions", np.zeros((1, 4)), r"positions: expected an array of shape \(N, 3\), got \(1, 4\)"),
    ("opacity_logits", np.zeros((1, 1)), r"opacity_logits: .* \(N,\), got \(1, 1\)"),
    ("sh", np.zeros((1, 3)), r"sh: expected an array of shape \(N, K, 3\), got \(1, 3\)"),
    ("sh", np.zeros((1, 2, 3)), "sh: expected K of 1, 4, 9 or 16, got 2"),
    ("log_scales", np.zeros((2, 3)), "log_scales: expected 1 rows as in positions, got 2"),
    ("control_paths", np.zeros((2, 3, 8)), "control_paths .* expected 1 rows as in .*, got 3"),
    ("control_log_radii", np.zeros(2), "control_log_radii: expected 1 rows as in .*, got 2"),
])
def test_wrong_shapes_tell_what_was_expected(name, value, text):
    with pytest.raises(ValueError, match=text):
        splat4d.Scene(**{**moving_arrays(), name: value})


def test_constants_of_blending_go_along_with_the_file(tmp_path):
    scene = splat4d.Scene(**gaussians(2))
    assert scene.blending["dilation"] == pytest.approx(0.3) and len(scene.blending) == 6
    scene.set_blending(dilation=0.5, alpha_cut=0.0)
    scene.save(tmp_path / "scene.safetensors")
    read = splat4d.Scene.open(tmp_path / "scene.safetensors").blending
    assert read == scene.blending and (read["dilation"], read["alpha_cut"]) == (0.5, 0.0)
    with pytest.raises(splat4d.Error, match="alpha_cap"):
        scene.set_blending(alpha_cap=2.0)
    with pytest.raises(TypeError, match='no constant "blur"'):
        scene.set_blending(blur=1.0)


def test_unknown_names_are_refused():
    with pytest.raises(TypeError, match='a scene has no array "positionen"'):
        splat4d.Scene(positionen=np.zeros((1, 3)))


def test_a_missing_file_is_named(tmp_path):
    path = tmp_path / "none.safetensors"
    with pytest.raises(splat4d.Error) as error:
        splat4d.Scene.open(path)
    assert str(error.value) == f"{path}: No such file or directory (os error 2)"
    path.write_bytes(b"no scene at all, but some bytes of text")
    with pytest.raises(splat4d.Error, match=str(path)):
        splat4d.Scene.open(path)


def test_a_pose_is_a_matrix_or_rotation_and_translation():
    angle = 0.3
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, [0.5, -1, 2]
    by_matrix = splat4d.Camera(8, 6, fx=5.0, view_from_world=matrix)
    np.testing.assert_allclose(by_matrix.view_from_world, matrix, atol=1e-15)
    np.testing.assert_allclose(by_matrix.centre, -rotation.T @ [0.5, -1, 2], atol=1e-15)
    quaternion = [np.cos(angle / 2), 0, np.sin(angle / 2), 0]
    np.testing.assert_allclose(by_matrix.rotation, quaternion, atol=1e-15)
    for given in (rotation, quaternion):
        camera = splat4d.Camera(8, 6, fx=5.0, rotation=given, translation=[0.5, -1, 2])
        np.testing.assert_allclose(camera.view_from_world, matrix, atol=1e-15)
    assert (by_matrix.fy, by_matrix.cx, by_matrix.cy) == (5.0, 4.0, 3.0)
    larger = by_matrix.resized(16, 12)
    assert (larger.fx, larger.cx, larger.width) == (10.0, 8.0, 16)
    with pytest.raises(ValueError, match=r"view_from_world: .* \(4, 4\), got \(3, 4\)"):
        splat4d.Camera(8, 6, fx=5.0, view_from_world=matrix[:3])
    with pytest.raises(ValueError, match="give either view_from_world, or rotation"):
        splat4d.Camera(8, 6, fx=5.0, view_from_world=matrix, translation=[0, 0, 0])
    with pytest.raises(splat4d.Error, match="not at right angles|at right angles"):
        splat4d.Camera(8, 6, fx=5.0, rotation=np.triu(np.ones((3, 3))))
    with pytest.raises(splat4d.Error, match="scale of 2.0, 1 expected"):
        splat4d.Camera(8, 6, fx=5.0, rotation=2 * np.eye(3))
    with pytest.raises(splat4d.Error, match="focal length -5.0"):
        splat4d.Camera(8, 6, fx=-5.0)
