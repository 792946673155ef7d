"""Our scanlines and Mitsuba, two renderers that share only the mesh."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview_ground.simulate import (
    MitsubaOptions,
    SceneOptions,
    ShadingOptions,
    render,
    render_frame,
)
from rendezview_ground.simulate.mitsuba_renderer import render_mitsuba

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: rendezview[mitsuba]")

CAMERA = Camera(160, 120, 220.0, 220.0, 83.0, 55.0)
POSE = Pose(np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]), [0.2, -0.1, 8.0])
SUN = np.array([0.5, -0.4, -0.768])
LAMBERT = MitsubaOptions(foil=0.0, ambient=0.0, samples=64)


@pytest.mark.requirement("RV-SIM-2")
def test_both_renderers_cover_the_same_pixels(bumpy_mesh):
    _, coverage = render_mitsuba(bumpy_mesh, CAMERA, POSE, SUN, LAMBERT)
    ours = render(bumpy_mesh, CAMERA, POSE, SUN, ShadingOptions(samples=8)).coverage
    assert np.abs(coverage - ours).max() < 0.3  # 64 random samples of an edge pixel
    assert coverage.sum() == pytest.approx(ours.sum(), rel=2e-3)
    x = np.arange(CAMERA.width)
    assert (coverage @ x).sum() / coverage.sum() == pytest.approx(
        (ours @ x).sum() / ours.sum(), abs=0.02
    )


def test_both_renderers_light_paint_alike(bumpy_mesh):
    radiance, _ = render_mitsuba(bumpy_mesh, CAMERA, POSE, SUN, LAMBERT)
    plain = ShadingOptions(samples=4, specular=0.0, ambient=0.0)
    ours = render(bumpy_mesh, CAMERA, POSE, SUN, plain).radiance
    lit = ours > 0.05
    assert np.median(radiance[lit] / ours[lit]) == pytest.approx(1.0, abs=0.06)


def test_the_earth_lights_the_side_that_faces_it(bumpy_mesh):
    dark = MitsubaOptions(ambient=0.0, foil=0.0, earthshine=0.5, samples=64)
    behind = np.array([0.0, 0.0, 1.0])  # the Sun behind the target: nothing of it is lit
    above, below = (
        render_mitsuba(bumpy_mesh, CAMERA, POSE, behind, dark, np.array([0.0, y, -0.6]) / 1.1662)[0]
        for y in (-1.0, 1.0)
    )
    nothing = render_mitsuba(bumpy_mesh, CAMERA, POSE, behind, dark)[0]
    assert nothing.max() < 1e-6
    assert above.sum() > 0.0
    assert below.sum() > 0.0
    rows = np.arange(CAMERA.height)[:, None]
    middle = [float((rows * p).sum() / p.sum()) for p in (above, below)]
    assert middle[0] < middle[1]  # light from above lights what is above


def test_a_scene_of_mitsuba_repeats_with_its_seed(bumpy_mesh):
    options = SceneOptions(sky_frame="camera", mitsuba=MitsubaOptions(samples=4))
    a, b, c = (
        render_frame(bumpy_mesh, CAMERA, POSE, SUN, options, np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_pixels_that_are_not_square_are_refused(bumpy_mesh):
    with pytest.raises(RendezviewError, match="fx = fy"):
        render_mitsuba(bumpy_mesh, Camera(160, 120, 220.0, 210.0, 80.0, 60.0), POSE, SUN, LAMBERT)


def test_a_target_behind_the_camera_is_refused(bumpy_mesh):
    near = Pose(POSE.rotation, [0.0, 0.0, 0.5])
    with pytest.raises(RendezviewError, match="behind the camera"):
        render_mitsuba(bumpy_mesh, CAMERA, near, SUN, LAMBERT)
