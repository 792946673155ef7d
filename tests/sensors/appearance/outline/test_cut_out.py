"""The part of a frame around the target."""

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance.outline.cut_out import CutOut
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    SilhouetteOptions,
    find_silhouette,
)

CAMERA = Camera(1200, 900, 1100.0, 1100.0, 600.2, 449.6)


def disc(centre_m: np.ndarray, radius_m: float, noise: float) -> np.ndarray:
    """A frame of a bright ball, drawn by the angle of each pixel's ray to its centre."""
    v, u = np.mgrid[0:900, 0:1200]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)])
    cosine = np.tensordot(centre_m, rays, 1) / np.linalg.norm(rays, axis=0)
    inside = cosine > np.sqrt(centre_m @ centre_m - radius_m**2)
    rng = np.random.default_rng(4)
    frame = np.where(inside, 140.0, 12.0) + rng.normal(0.0, noise, u.shape)
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)


def middle_of(outline: np.ndarray) -> np.ndarray:
    """The centroid of the area of a polygon."""
    beside = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * beside[:, 1] - beside[:, 0] * outline[:, 1]
    return cross @ (outline + beside) / (3.0 * cross.sum())


@pytest.mark.parametrize(
    ("centre_m", "times"),
    [((0.4, -0.3, 12.0), 1), ((0.8, 0.4, 4.4), 2), ((-1.0, 0.3, 4.5), 2), ((0.0, 0.0, 2.9), 4)],
)
def test_the_outline_is_that_of_the_whole_frame(centre_m, times):
    centre = np.array(centre_m)
    frame = disc(centre, 0.9, 2.0)
    cut = CutOut.about(frame, CAMERA, centre, 1.0)
    assert cut.times == times
    assert cut.picture.size * times**2 < frame.size
    whole = find_silhouette(frame, SilhouetteOptions(), CAMERA.project(centre))
    averaged_px = 3 if times == 1 else 1
    found = find_silhouette(cut.picture, SilhouetteOptions(averaged_px=averaged_px))
    assert not isinstance(whole, Missing)
    assert not isinstance(found, Missing)
    found = cut.in_frame(found)
    np.testing.assert_allclose(found.area_px, whole.area_px, rtol=0.02)
    np.testing.assert_allclose(found.box_px, whole.box_px, atol=times + 1)
    assert found.sky_grey == pytest.approx(whole.sky_grey, abs=1.0)
    middles = [middle_of(o.outlines_px[0]) for o in (found, whole)]
    np.testing.assert_allclose(*middles, atol=0.1)
    place = (cut.centre_px + 0.5) * times - 0.5 + cut.corner_px
    np.testing.assert_allclose(place, CAMERA.project(centre))


def test_a_target_around_the_camera_or_behind_it_leaves_the_frame_whole():
    frame = np.zeros((900, 1200), dtype=np.uint8)
    for centre in ([0.0, 0.0, 1.1], [0.0, 0.0, -4.0]):
        assert CutOut.about(frame, CAMERA, np.array(centre), 1.0).picture is frame
