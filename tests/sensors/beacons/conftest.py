"""Fixtures of the papers: Book's camera and target with pictures of it, Welch's laboratory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.io.target import Target
from rendezview.sensors.beacons import LitDark, ReflectorPattern, Rig, SixNumbers, Spots, pose_of
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.reflector_frames import ReflectorFrameOptions, render_pair

SCOLE = Path(__file__).resolve().parents[3] / "models_cad" / "scole"
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


@pytest.fixture(scope="session")
def scole() -> Target:
    return Target.load(SCOLE)


@pytest.fixture(scope="session")
def leds(scole: Target) -> np.ndarray:
    return np.array([led.position_m for led in scole.leds])


@pytest.fixture(scope="session")
def laboratory(leds: np.ndarray) -> Laboratory:
    """Perfect lens and detectors, so that its own rig reads it without bias."""
    return Laboratory(leds, LaboratoryOptions(distorted=False), seed=1)


@pytest.fixture(scope="session")
def read():
    """Currents (C, L, 4) of one reading → spots of each camera."""

    def of(rig: Rig, currents: np.ndarray) -> list[Spots]:
        return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]

    return of
