"""The share of the calibration in a pose's covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.plain_readings import squared_error

from rendezview.calibration.board import misfit
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import Rig, Spots, StereoTracker
from rendezview.sensors.beacons.calibration_error import CalibrationError
from rendezview.sensors.beacons.rig import INTRINSICS, RigCamera, intrinsics_of, with_intrinsics
from rendezview.sensors.beacons.rig import POSE as PLACE
from rendezview.sensors.beacons.stereo_tracker import TrackerOptions
from rendezview.sensors.measurement import turned

LEDS = np.array(
    [[0.3, 0, 0], [-0.3, 0, 0], [0, 0.3, 0], [0, -0.3, 0.05], [0, 0, 0.3], [0.2, 0.2, -0.1]]
)
POSE = Pose.identity().perturbed([0.2, 2.9, 0.1, 0.1, -0.1, 3.0])
NAMES = (
    *(f"{c}.{n}" for c in ("left", "right") for n in ("fx", "fy", "cx", "cy", "l1", "p1")),
    *(f"right.{n}" for n in ("wx", "wy", "wz", "tx", "ty", "tz")),
)
SIGMA = 0.1 * np.array([0.8, 0.8, 1.2, 1.2, 2e-3, 3e-4] * 2 + [3e-4] * 3 + [4e-4] * 3)


@pytest.fixture(scope="module")
def rig():
    camera = Camera(1280, 960, 1200.0, 1200.0, 639.5, 479.5, (-0.1, 0.05, 0.0, 0.0, 0.0))
    right = Pose.identity().perturbed([0.0, 0.1, 0.0, -0.5, 0.0, 0.0])
    rng = np.random.default_rng(0)
    mix = np.eye(len(SIGMA)) + 0.2 * rng.normal(size=(len(SIGMA), len(SIGMA)))
    covariance = SIGMA[:, None] * (mix @ mix.T) * SIGMA
    cameras = (
        RigCamera.from_camera("left", camera, Pose.identity()),
        RigCamera.from_camera("right", camera, right),
    )
    return Rig(cameras, covariance, NAMES)


def moved(camera, name, step):
    """The camera with one number of its calibration changed."""
    values, change = intrinsics_of(camera), np.zeros(6)
    if name in PLACE:
        change[PLACE.index(name)] = step
    else:
        values[INTRINSICS.index(name)] += step
    return with_intrinsics(camera, values, camera.camera_from_rig.perturbed(change))


def wrong(rig, errors):
    """The rig with errors in its calibration."""
    cameras = list(rig.cameras)
    for name, error in zip(NAMES, errors, strict=True):
        k = 0 if name.startswith("left") else 1
        cameras[k] = moved(cameras[k], name.split(".")[1], error)
    return replace(rig, cameras=tuple(cameras))


def spots(rig, rng, sigma_px=0.1):
    found = []
    for camera in rig.cameras:
        places = camera.project(POSE.apply(LEDS)) + rng.normal(0.0, sigma_px, (len(LEDS), 2))
        found.append(Spots(places, np.full((len(LEDS), 2), sigma_px), np.arange(len(LEDS))))
    return found


def test_poses_of_wrong_calibrations_are_off_by_what_they_claim(rig):
    rng, nees, without = np.random.default_rng(1), [], []
    root = np.linalg.cholesky(rig.covariance)
    for _ in range(60):
        taken = wrong(rig, root @ rng.normal(size=len(SIGMA)))
        for chosen, out in ((taken, nees), (replace(taken, covariance=None), without)):
            options = TrackerOptions(calibration_error=True)
            reading = StereoTracker(chosen, LEDS, options=options).update(0.0, spots(rig, rng))
            if reading.pose is None:  # the cameras contradict each other
                continue
            out.append(squared_error(reading, chosen.cameras[0].camera_from_rig @ POSE))
    assert len(nees) > 30
    assert 4.0 < np.mean(nees) < 8.0
    assert np.mean(without) > 2.0 * np.mean(nees)


def test_the_share_is_that_of_numeric_slopes_of_the_whole_projection(rig):
    error = CalibrationError(rig, LEDS)
    assert error
    shares = error.shares(POSE, np.full((2, len(LEDS), 2), 1e4))

    def slope(by, step):
        """Of all places, in focal lengths of the given rig."""
        ends = []
        for cameras, pose in (by(step), by(-step)):
            places = [camera.project(pose.apply(LEDS)).ravel() for camera in cameras]
            ends.append(np.concatenate(places) / rig.cameras[0].fx)
        return (ends[0] - ends[1]) / (2.0 * np.abs(step).max())

    units = np.eye(6)
    by_pose = [slope(lambda s: (rig.cameras, POSE.perturbed(s)), 1e-6 * e) for e in units]
    by_number = [
        slope(lambda s: (wrong(rig, s).cameras, POSE), step) for step in np.diag(1e-3 * SIGMA)
    ]
    by_pose, by_number = np.array(by_pose).T, np.array(by_number).T
    pull = np.linalg.lstsq(by_pose, by_number, rcond=None)[0]
    wanted = pull @ rig.covariance @ pull.T
    np.testing.assert_allclose(shares["calibration"], wanted, rtol=1e-3, atol=1e-4 * wanted.max())
    assert shares["places"] is None
    assert not CalibrationError(replace(rig, covariance=None, covariance_names=()), LEDS)


def test_of_the_floor_only_the_share_of_the_lens_model_is_an_error_of_a_pose(rig):
    """Weights that allow for the whole residual leave the estimate, but not its covariance."""
    floor, misfit, sigma = 0.15, 0.02, 0.05
    cameras = tuple(replace(c, floor=floor, misfit=misfit) for c in rig.cameras)
    known = replace(rig, cameras=cameras)
    rng, nees = np.random.default_rng(2), []
    options = TrackerOptions(calibration_error=True)
    for _ in range(150):
        tracker = StereoTracker(replace(known, covariance=1e-12 * rig.covariance), LEDS,
                                options=options)  # fmt: skip
        given = [
            replace(found, sigma=np.full_like(found.sigma, sigma))
            for found in spots(rig, rng, np.hypot(sigma, misfit))
        ]
        nees.append(squared_error(tracker.update(0.0, given), POSE))
    assert 5.0 < np.mean(nees) < 7.2
    unknown = CalibrationError(rig, LEDS)  # whose share of the lens model is not known
    weight = np.full((2, len(LEDS), 2), 1e4)
    exact = CalibrationError(replace(rig, cameras=tuple(
        replace(c, floor=0.0, misfit=0.0) for c in rig.cameras)), LEDS)  # fmt: skip
    np.testing.assert_allclose(
        unknown.shares(POSE, weight)["spots"], exact.shares(POSE, weight)["spots"]
    )


def test_poses_of_lights_mounted_aside_are_off_by_what_they_claim(rig):
    """σ of a light's place, 2 mm of 600: ten times the noise of its spots."""
    rng, nees, sigmas = np.random.default_rng(5), [], np.array([2e-3, 0.0, 2e-3, 1e-3, 1e-3, 2e-3])
    exact, without = replace(rig, covariance=None, covariance_names=()), []
    for _ in range(60):
        given = LEDS + rng.normal(size=LEDS.shape) * sigmas[:, None]
        for known, out in ((sigmas, nees), (None, without)):
            reading = StereoTracker(exact, given, sigmas_m=known).update(0.0, spots(exact, rng))
            if reading.pose is None:  # the lights contradict each other
                continue
            out.append(squared_error(reading, POSE))
    assert len(nees) == 60
    assert 4.5 < np.mean(nees) < 7.8
    assert len(without) < 30 or np.mean(without) > 5.0 * np.mean(nees)
    budget = StereoTracker(exact, LEDS, sigmas_m=sigmas).update(0.0, spots(exact, rng)).budget
    assert budget["calibration"] is None
    assert budget["places"].turn_rad > budget["spots"].turn_rad


def test_the_misfit_is_what_neighbouring_corners_share():
    rng, size = np.random.default_rng(3), (640, 480)
    places = rng.uniform((0.0, 0.0), size, (1500, 2))
    noise = rng.normal(0.0, 0.15, places.shape)
    assert misfit(places, noise, size) < 0.03
    bent = 0.1 * np.sin(places / 200.0)
    wanted = np.sqrt(np.mean(bent**2))
    assert misfit(places, noise + bent, size) == pytest.approx(wanted, rel=0.15)
    assert misfit(places[:1], noise[:1], size) == pytest.approx(np.sqrt((noise[:1] ** 2).mean()))


def test_a_covariance_turns_with_its_frame():
    rotation = Pose.identity().perturbed([0.3, -0.5, 0.2, 0, 0, 0]).rotation
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    there = turned(covariance, rotation)
    np.testing.assert_allclose(there[:3, :3], rotation @ covariance[:3, :3] @ rotation.T)
    np.testing.assert_allclose(np.linalg.eigvalsh(there), [1, 2, 3, 4, 5, 6])
