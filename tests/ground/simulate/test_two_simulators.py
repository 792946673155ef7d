"""The product's pictures of reflectors against those of a plain simulator."""

from __future__ import annotations

import numpy as np
import pytest
from tests import plain_pictures as plain

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import ReflectorPattern
from rendezview_ground.simulate.reflector_frames import (
    ReflectorFrameOptions,
    exposure,
    reflector_light,
)


@pytest.mark.parametrize("even", [False, True])
def test_two_simulators_agree_on_a_wide_tilted_disc(even: bool):
    pinhole = plain.Pinhole()
    camera = Camera(512, 384, pinhole.focal_px, pinhole.focal_px, pinhole.cx, pinhole.cy)
    pattern = ReflectorPattern(
        "three", ("left", "post", "right"),
        np.array([[-0.18, 0.0, 0.0], [0.0, 0.0, 0.1], [0.18, 0.0, 0.0]]),
        np.tile([0.0, 0.0, 1.0], (3, 1)), np.full(3, 0.05),
    )  # fmt: skip
    placed = plain.look_at(np.random.default_rng(3), pinhole, 0.6, 0.6, 180.0)
    theirs = plain.discs(
        pinhole, *placed, pattern.positions_m, pattern.normals, pattern.diameters_m,
        plain.Look(even=even), (0, 2),
    )  # fmt: skip
    pose, options = Pose(*placed), ReflectorFrameOptions(even_light=even)
    ours = reflector_light(
        camera, pattern, pose, options, exposure(camera, pattern, pose, options), (0, 2)
    )
    assert np.abs(ours / ours.max() - theirs / theirs.max()).max() < 0.02
    places = np.indices(ours.shape)
    ours_at, theirs_at = ((light * places).sum((1, 2)) / light.sum() for light in (ours, theirs))
    assert np.abs(ours_at - theirs_at).max() < 0.005  # px
