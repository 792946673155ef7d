"""Blurred frames: how blurred a frame is, and what is seen in the smaller one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.grey_frame import _slope, _slope_kernel, frame_blur, shrunk
from rendezview.sensors.appearance import Recognizer
from rendezview.sensors.appearance.region import Region
from rendezview.sensors.appearance.scale import WHOLE, Scale
from rendezview.sensors.observation import Status

CAMERA = Camera.from_fov(400, 400, np.deg2rad(40.0))


def polygons(seed: int, blur_px: float, noise_grey: float = 1.0) -> np.ndarray:
    """A picture (300, 400) of grey polygons; blur by a pixel's own square included."""
    rng = np.random.default_rng(seed)
    fine = np.full((1200, 1600), 20.0, dtype=np.float32)
    for _ in range(12):
        corners = rng.uniform((0, 0), (1600, 1200), 2) + rng.uniform(-300, 300, (4, 2))
        cv2.fillConvexPoly(fine, cv2.convexHull(corners.astype(np.int32)), rng.uniform(30, 240))
    fine = cv2.GaussianBlur(fine, (0, 0), 4.0 * blur_px)
    frame = cv2.resize(fine, (400, 300), interpolation=cv2.INTER_AREA)
    frame = frame + rng.normal(0.0, noise_grey, frame.shape)
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("blur_px", [1.5, 2.0, 3.0])
def test_the_blur_of_a_frame_is_measured(blur_px):
    found = [frame_blur(polygons(seed, blur_px)) for seed in range(6)]
    assert np.median(found) == pytest.approx(blur_px, rel=0.25)
    assert min(found) > 1.2


def test_a_sharp_frame_and_one_without_edges_are_looked_at_as_they_are():
    for seed in range(6):
        assert Scale.of(polygons(seed, 0.7)) is WHOLE
    grain = np.random.default_rng(1).normal(90.0, 12.0, (200, 300)).astype(np.uint8)
    ramp = np.tile(np.arange(0, 250, dtype=np.uint8), (200, 1))
    for frame in (grain, ramp, np.zeros((200, 300), np.uint8), np.zeros((9, 9), np.uint8)):
        assert Scale.of(frame) is WHOLE


def test_the_slope_of_a_plane_is_its_own():
    rows, columns = np.mgrid[:21, :21]
    plane = (40 + 3 * columns + 5 * rows).astype(np.uint8)
    for sigma_px, reach_px in ((1.0, 3), (2.0, 6)):
        kernel = _slope_kernel(sigma_px, reach_px)
        assert _slope(plane, 10, 10, kernel) == pytest.approx((3.0, 5.0))


def test_a_region_of_a_frame_is_one_of_the_smaller_frame():
    mask = np.zeros((400, 400), np.uint8)
    cv2.circle(mask, (171, 143), 61, 1, -1)
    frame = np.random.default_rng(2).integers(0, 255, (400, 400)).astype(np.uint8)
    for times in (1, 2, 3):
        for roi in ((111.0, 83.0, 121.0, 121.0), (171.0, 143.0, 9.0), mask):
            small = Region.of(roi, CAMERA).shrunk(times)
            camera = small.seen_by(CAMERA.binned(times))
            part = small.cut(shrunk(frame, times))
            assert part.shape == (camera.height, camera.width)
            if small.box_px is not None:
                middle = 0.5 * (small.box_px[:2] + small.box_px[2:])
                expected = (np.array([171.0, 143.0]) + 0.5) / times - 0.5
                assert np.abs(middle - expected).max() < 1.0
            if small.mask is not None:
                assert small.mask.shape == part.shape
                moment = cv2.moments(small.mask, binaryImage=True)
                at = np.array([moment["m10"], moment["m01"]]) / moment["m00"] + small.part[:2]
                assert np.abs(at - middle).max() < 0.6
                assert moment["m00"] * times**2 == pytest.approx(mask.sum(), rel=0.03)


@pytest.fixture(scope="module")
def recognizer(refining_model) -> Recognizer:
    return Recognizer(refining_model, CAMERA)


@pytest.mark.parametrize("blur_px", [1.8, 2.6])
def test_a_blurred_target_is_found_in_its_place(recognizer, bumpy_mesh, draw, blur_px):
    rng = np.random.default_rng(4)
    model, firsts = recognizer.model, 0
    for _ in range(6):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        truth = Pose(rotation, np.array([0.05, -0.03, 1.0]) * 6.0 * model.target_radius_m)
        sharp = draw(bumpy_mesh, truth, CAMERA).astype(np.float32)
        frame = cv2.GaussianBlur(sharp, (0, 0), np.sqrt(blur_px**2 - 0.7**2))
        frame = np.clip(np.rint(frame + rng.normal(0.0, 1.5, frame.shape)), 0, 255).astype(np.uint8)
        assert Scale.of(frame).times == 2
        turned = truth.perturbed(np.array([0.05, -0.03, 0.02, 0.0, 0.0, 0.0]))
        left, top, right, bottom = recognizer.recognize(
            sharp.astype(np.uint8), truth
        ).silhouette.box_px
        for roi in (None, (left, top, right - left, bottom - top)):
            seen = recognizer.recognize(frame, turned, roi=roi)
            assert seen.status is Status.OK
            assert seen.pose.angle_to(truth) < np.deg2rad(3.0)
            range_m = np.linalg.norm(truth.translation_m)
            assert np.linalg.norm(seen.pose.translation_m - truth.translation_m) < 0.02 * range_m
            assert np.allclose(seen.silhouette.box_px, (left, top, right, bottom), atol=4)
        first = recognizer.recognize(frame).pose
        firsts += first is not None and first.angle_to(truth) < np.deg2rad(3.0)
    assert firsts >= 3
