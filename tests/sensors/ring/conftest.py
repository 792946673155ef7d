"""A camera, rings seen by it, and frames of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview_ground.simulate.ring_frames import (
    RingScene,
    RingSceneOptions,
    random_scene,
    render_ring_frame,
)
from rendezview_ground.simulate.sensor import SensorOptions

Make = Callable[..., tuple[RingScene, np.ndarray]]


@pytest.fixture(scope="session")
def ring_camera() -> Camera:
    return Camera.from_fov(640, 480, math.radians(40.0))


@pytest.fixture
def make(ring_camera: Camera) -> Make:
    """A random scene with a ring, and its picture."""

    def call(seed, *, camera=None, noise=3.0, **options) -> tuple[RingScene, np.ndarray]:
        rng = np.random.default_rng(seed)
        scene = random_scene(camera or ring_camera, rng, RingSceneOptions(**options))
        sensor = SensorOptions(noise_sigma_grey=noise, black_level_grey=0.0)
        return scene, render_ring_frame(scene, rng, sensor)

    return call
