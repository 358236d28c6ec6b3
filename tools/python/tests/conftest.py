"""Fixtures and helpers of the tests. The tests run on a software driver: results do not depend on the GPU."""

import signal

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
