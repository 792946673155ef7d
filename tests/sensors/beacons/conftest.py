"""The paper's camera and target, and simulated pictures of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.io.target import Target
from rendezview.sensors.beacons import LitDark, ReflectorPattern, SixNumbers, pose_of
from rendezview_ground.simulate.reflector_frames import ReflectorFrameOptions, render_pair

BASE_M, POST_M = 14.5 * 0.0254, 4 * 0.0254


@pytest.fixture(scope="session")
def paper_camera() -> Camera:
    return Camera(512, 384, 651.975, 651.975, 255.5, 191.5)


@pytest.fixture(scope="session")
def three() -> ReflectorPattern:
    """The paper's target, in its face frame: base 14.5 in, post 4 in."""
    return ReflectorPattern(
        "small",
        ("left", "post", "right"),
        np.array([[-BASE_M / 2, 0.0, 0.0], [0.0, 0.0, POST_M], [BASE_M / 2, 0.0, 0.0]]),
        np.tile([0.0, 0.0, 1.0], (3, 1)),
        np.full(3, 0.025),
    )


@pytest.fixture(scope="session")
def five() -> ReflectorPattern:
    """Bales' redundant target: two more reflectors across, nearer to the post."""
    half = BASE_M / 2
    return ReflectorPattern(
        "five",
        ("left", "post", "right", "top", "bottom"),
        np.array(
            [[-half, 0, 0], [0, 0, POST_M], [half, 0, 0], [0, 0.75 * half, 0], [0, -0.75 * half, 0]]
        ),
        np.tile([0.0, 0.0, 1.0], (5, 1)),
        np.full(5, 0.025),
    )


@pytest.fixture(scope="session")
def client() -> Target:
    return Target.load(Path(__file__).resolve().parents[3] / "models_cad" / "client")


@pytest.fixture
def picture(paper_camera):
    """Pictures of a pattern at six numbers (or a pose)."""

    def make(pattern, six, rng, *, hidden=(), clutter=(), dark=True, **options) -> LitDark:
        pose = pose_of(six, pattern) if isinstance(six, SixNumbers) else six
        lit, without = render_pair(
            paper_camera, pattern, pose, ReflectorFrameOptions(**options), rng,
            hidden=hidden, clutter=clutter,
        )  # fmt: skip
        return LitDark(lit, without if dark else None)

    return make
