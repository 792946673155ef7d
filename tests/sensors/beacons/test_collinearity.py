"""Eq. 3 and 4: derivatives, one and all iterations, angles at the edge."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tests.plain_laboratory import rotation_of

from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import yaw_pitch_roll
from rendezview.sensors.beacons.match.agreement import iterate
from rendezview.sensors.beacons.match.start import squares
from rendezview.sensors.beacons.pose.collinearity import (
    count_lights,
    normal_equations,
    solve,
)
from rendezview_ground.simulate.led_laboratory import Laboratory

POSE = Pose(rotation_of(0.7, 0.2, -0.1), [0.05, -0.08, 0.3])


def predicted(laboratory: Laboratory, pose: Pose) -> np.ndarray:
    """(C, L, 2) by plain numpy: the reference."""
    out = []
    for camera in laboratory.rig.cameras:
        p = camera.camera_from_rig.apply(pose.apply(laboratory.leds))
        out.append(p[:, :2] / p[:, 2:])
    return np.array(out)


def test_the_normal_equations_are_those_of_numerical_derivatives(laboratory: Laboratory):
    rng = np.random.default_rng(1)
    xy = predicted(laboratory, POSE) + rng.normal(0.0, 1e-3, (2, 6, 2))
    weight = rng.uniform(500.0, 1000.0, xy.shape)
    weight[1, 2] = 0.0
    information, gradient = np.empty((6, 6)), np.empty(6)
    rig = laboratory.rig
    cost = normal_equations(
        POSE.rotation, POSE.translation_m, laboratory.leds, rig.rotations, rig.translations,
        xy, weight, information, gradient,
    )  # fmt: skip
    h = 1e-6
    columns = [
        (predicted(laboratory, POSE.perturbed(s)) - predicted(laboratory, POSE.perturbed(-s)))
        / (2 * h)
        for s in np.eye(6) * h
    ]
    jacobian = np.stack([(weight * c).ravel() for c in columns], axis=1)
    residual = (weight * (xy - predicted(laboratory, POSE))).ravel()
    assert cost == pytest.approx(residual @ residual)
    assert gradient == pytest.approx(jacobian.T @ residual, rel=1e-6, abs=1e-3)
    assert information == pytest.approx(jacobian.T @ jacobian, rel=1e-6, abs=1e-2)


def test_iteration_ends_where_scipys_least_squares_ends(laboratory: Laboratory, read):
    rng = np.random.default_rng(2)
    rig, leds = laboratory.rig, laboratory.leds
    sights = rig.sights(read(rig, laboratory.currents([POSE], rng)[0]), 6)
    fit = iterate(rig, leds, sights, POSE.rotation, POSE.translation_m)

    def residual(step: np.ndarray) -> np.ndarray:
        return (sights.weight * (predicted(laboratory, POSE.perturbed(step)) - sights.xy)).ravel()

    peer = least_squares(residual, np.zeros(6), method="lm", xtol=1e-12)
    assert fit.cost == pytest.approx(2.0 * peer.cost, rel=1e-4)
    away = Pose(fit.rotation, fit.translation)
    other = POSE.perturbed(peer.x)
    assert away.angle_to(other) < 2e-3  # a twentieth of its σ
    assert fit.information == pytest.approx(peer.jac.T @ peer.jac, rel=0.05, abs=1e5)


def test_one_iteration_after_two_degrees_is_within_one_of_the_end(laboratory: Laboratory, read):
    rng = np.random.default_rng(3)
    rig, leds = laboratory.rig, laboratory.leds
    for yaw in np.linspace(-3.0, 3.0, 40):
        before = Pose(rotation_of(yaw, 0.1, -0.2), [0.0, 0.0, 0.1])
        after = Pose(rotation_of(yaw + np.deg2rad(2.0), 0.1, -0.2), [0.0, 0.0, 0.1])
        sights = rig.sights(read(rig, laboratory.currents([after], rng)[0]), 6)
        once = iterate(rig, leds, sights, before.rotation, before.translation_m, iterations=1)
        end = iterate(rig, leds, sights, before.rotation, before.translation_m)
        turned = Rotation.from_matrix(once.rotation @ end.rotation.T).magnitude()
        assert np.rad2deg(turned) < 1.0


@pytest.mark.parametrize("angles", [(0.3, -0.4, 0.5), (-3.0, 1.5, 2.9), (1.0, -1.2, -2.0)])
def test_yaw_pitch_roll_are_those_of_equation_3(angles: tuple[float, float, float]):
    yaw, pitch, roll = angles
    rotation = rotation_of(yaw, pitch, roll)
    assert rotation == pytest.approx(
        Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), abs=1e-15
    )
    assert yaw_pitch_roll(rotation) == pytest.approx(angles)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_straight_up_and_down_roll_is_zero_and_the_attitude_right(pitch: float):
    rotation = rotation_of(0.4, pitch, 0.9)
    angles = yaw_pitch_roll(rotation)
    assert angles.roll == 0.0
    assert rotation_of(*angles) == pytest.approx(rotation, abs=1e-7)


def test_lights_and_equations_are_counted_over_all_cameras():
    rng = np.random.default_rng(4)
    for _ in range(50):
        weight = rng.uniform(500.0, 1000.0, (2, 6, 2))
        weight[rng.random((2, 6)) < 0.6] = 0.0
        visible = weight[..., 0] > 0.0
        assert count_lights(weight) == (visible.any(axis=0).sum(), 2 * visible.sum())


def test_squares_are_those_of_the_projection_and_infinite_behind_or_turned_away(
    laboratory: Laboratory,
):
    rng = np.random.default_rng(7)
    rig = laboratory.rig
    xy = predicted(laboratory, POSE) + rng.normal(0.0, 1e-3, (2, 6, 2))
    weight = rng.uniform(500.0, 1000.0, xy.shape)
    weight[1, 2] = 0.0
    expected = ((weight * (xy - predicted(laboratory, POSE))) ** 2).sum(axis=2)
    own = [values.swapaxes(0, 1)[:, :, None] for values in (xy, weight)]
    normals = np.zeros((6, 3))

    def found(place_m: np.ndarray) -> np.ndarray:
        poses = POSE.rotation[None], place_m[None]
        return squares(poses, rig, laboratory.leds, normals, *own)[0, :, :, 0].T

    assert found(POSE.translation_m) == pytest.approx(expected)
    camera = rig.cameras[0].camera_from_rig
    normals[3] = POSE.rotation.T @ camera.rotation.T @ np.array([0.0, 0.0, 1.0])  # away from it
    assert np.isinf(found(POSE.translation_m)[0, 3])
    assert np.isinf(found(camera.inverse().apply(np.array([0.0, 0.0, -5.0])))[0]).all()


def test_a_solution_with_a_prior_is_that_of_scipy(laboratory: Laboratory):
    rng = np.random.default_rng(8)
    rig, leds = laboratory.rig, laboratory.leds
    xy = predicted(laboratory, POSE) + rng.normal(0.0, 1e-3, (2, 6, 2))
    weight = np.full(xy.shape, 800.0)
    root = np.diag([300.0, 200.0, 100.0, 400.0, 500.0, 600.0])
    given = POSE.perturbed(1e-3 * np.array([1.0, -2.0, 1.0, 2.0, 1.0, -3.0]))

    def residuals(step: np.ndarray) -> np.ndarray:
        pose = given.perturbed(step)
        misfit = (weight * (predicted(laboratory, pose) - xy)).ravel()
        turn = Rotation.from_matrix(pose.rotation @ given.rotation.T).as_rotvec()
        return np.concatenate(
            [misfit, root @ np.append(turn, pose.translation_m - given.translation_m)]
        )

    wanted = least_squares(residuals, np.zeros(6), x_scale="jac", ftol=1e-15, xtol=1e-15)
    expected = given.perturbed(wanted.x)
    rotation, translation = given.rotation.copy(), given.translation_m.copy()
    information = np.empty((6, 6))
    cost, steps, ended = solve(
        rotation, translation, leds, rig.rotations, rig.translations, xy, weight, root @ root,
        given.rotation.copy(), given.translation_m.copy(), 20, 1e-4, information,
    )  # fmt: skip
    assert ended
    assert 1 < steps < 20
    assert cost == pytest.approx(2.0 * wanted.cost, rel=1e-6)
    # Away from the prior by a, its slope is taken to be I, which is a / 2 off.
    assert rotation == pytest.approx(expected.rotation, abs=1e-6)
    assert translation == pytest.approx(expected.translation_m, abs=1e-6)
