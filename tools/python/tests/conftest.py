"""Fixtures and helpers of the tests. The tests run on a software driver: results do not depend on the GPU."""

import signal
import subprocess
import sys
import zlib

import numpy as np
import pytest

import splat4d

SH_C0 = 0.28209479177387814


@pytest.fixture(scope="session")
def device():
    return splat4d.Device("software")


@pytest.fixture
def ctrl_c():
    """Raises KeyboardInterrupt on SIGINT, also if the tests were started with SIGINT ignored, as shells do in the
    background. Programs that the test starts get the default handling, too."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def gaussians(count, seed=0, degree=0):
    """Arrays of Gaussians in a box in front of the camera at the origin."""
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    return {
        "positions": random.uniform([-1, -0.7, 2.5], [1, 0.7, 4.5], size=(count, 3)),
        "log_scales": random.uniform(-2.5, -1.2, size=(count, 3)),
        "rotations": rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        "opacity_logits": random.uniform(-1, 2, size=count),
        "sh": random.uniform(-0.8, 0.8, size=(count, (degree + 1) ** 2, 3)),
    }


def moving_arrays():
    """One Gaussian at depth 2 that moves from x = 0 at time 0 to x = 0.4 at time 1."""
    paths = np.zeros((2, 1, 8))
    paths[1, 0, 0] = 0.4
    return {
        "positions": [[0, 0, 2]],
        "log_scales": [[-3, -3, -3]],
        "rotations": [[1, 0, 0, 0]],
        "opacity_logits": [2],
        "sh": np.full((1, 1, 3), 0.5),
        "motion_logits": [1],
        "control_positions": [[0, 0, 2]],
        "control_log_radii": [-1],
        "control_paths": paths,
    }


@pytest.fixture
def camera():
    return splat4d.Camera(65, 49, fx=60.0)


def command_line(*arguments):
    """Runs the package's command line on the software driver."""
    done = subprocess.run(
        [sys.executable, "-m", "splat4d", "--device", "software", *map(str, arguments)],
        capture_output=True, text=True,
    )
    assert done.returncode == 0, done.stderr


def read_exr(path):
    """The channels of an OpenEXR file of 32-bit floats, by name: those that the program writes are compressed by
    zlib in blocks of 16 rows."""
    data = path.read_bytes()
    assert data[:8] == bytes.fromhex("762f310102000000"), "one part of scan lines"
    at, header = 8, {}
    while data[at]:
        name, kind, rest = data[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        size = int.from_bytes(data[at : at + 4], "little")
        header[name.decode()] = data[at + 4 : at + 4 + size]
        at += 4 + size
    left, top, right, bottom = np.frombuffer(header["dataWindow"], "<i4")
    width, height, rows = right - left + 1, bottom - top + 1, 16
    assert header["compression"] == b"\3"
    # A channel: its name, its type, and 12 bytes of which float channels have no need.
    channels, listed = [], header["channels"]
    while listed[0]:
        name, listed = listed.split(b"\0", 1)
        assert listed[0] == 2, "floats"
        channels.append(name.decode())
        listed = listed[16:]
    lines = []
    offsets = np.frombuffer(data, "<u8", -(-height // rows), at + 1)
    for block, offset in enumerate(offsets):
        count = min(rows, height - rows * block)
        size = int.from_bytes(data[offset + 4 : offset + 8], "little")
        packed, length = data[offset + 8 : offset + 8 + size], 4 * width * count * len(channels)
        if size == length:
            plain = np.frombuffer(packed, np.uint8)
        else:
            # Each byte is stored as the difference from the one before it, first those at even places.
            steps = np.frombuffer(zlib.decompress(packed), np.uint8).astype(np.int64)
            steps[1:] -= 128
            halves = np.cumsum(steps).astype(np.uint8)
            plain = np.empty(length, np.uint8)
            plain[0::2], plain[1::2] = np.split(halves, [(length + 1) // 2])
        lines.append(plain.view("<f4").reshape(count, len(channels), width))
    return dict(zip(channels, np.concatenate(lines).transpose(1, 0, 2)))


def assert_shown(folder, index, rendered):
    """The image in the folder that `render --exr` wrote has the bits of the rendered one."""
    channels = read_exr(folder / f"{index:04}.exr")
    found = np.stack([channels[name] for name in "RGBA"], axis=-1)
    assert found.shape == rendered.rgba.shape and found[..., 3].max() > 0.5
    assert found.tobytes() == rendered.rgba.tobytes()
