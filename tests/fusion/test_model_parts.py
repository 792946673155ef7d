"""The parts of the measurement models beside their definitions and numerical derivatives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.fusion.models import circle_parts, of_other_edge, ring_parts
from rendezview.sensors.measurement import tangents


def covariance_of(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


def hat(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def a_ring(rng):
    """Centre and axis on the target, rotation, the camera's place 8 m before it."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    axis = rng.standard_normal(3)
    place = -rotation.T @ np.array([0.3, -0.2, 8.0])
    return rng.standard_normal(3), axis / np.linalg.norm(axis), rotation, place


@pytest.mark.parametrize("seed", range(3))
def test_a_ring_is_where_numpy_puts_it(seed):
    rng = np.random.default_rng(seed)
    centre, axis, rotation, place = a_ring(rng)
    if seed == 2:  # along the camera's x: another tangent
        axis = rotation.T @ np.array([-1.0, 0.0, 0.0])
    radius, depth_m = 1.1, 0.2
    found, direction, basis, motion = ring_parts(centre, axis, rotation, place, radius, depth_m)
    expected = rotation @ (centre + depth_m * axis - place) / radius
    assert found == pytest.approx(expected, abs=1e-12)
    assert direction == pytest.approx(rotation @ axis, abs=1e-12)
    assert basis == pytest.approx(tangents(direction), abs=1e-9)
    frame = np.column_stack([basis, direction])
    assert frame.T @ frame == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    for column in range(8):
        ends = []
        for step in (1e-6, -1e-6):
            tip = step * np.eye(8)[column]
            there = ring_parts(
                centre, axis, Rotation.from_rotvec(tip[:3]).as_matrix() @ rotation,
                place + tip[3:6], radius + tip[6], depth_m + tip[7],
            )  # fmt: skip
            ends.append(np.concatenate([there[0], basis.T @ there[1]]))
        assert motion[:, column] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-7), column


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_circle_beside_the_expected_one_is_that_of_numpy(sign):
    rng = np.random.default_rng(5)
    centre, axis, basis, _ = ring_parts(*a_ring(rng), 1.0, 0.0)
    measured, given = centre + 0.1 * rng.standard_normal(3), covariance_of(rng, 6)
    normal = sign * (axis + 0.05 * rng.standard_normal(3))
    normal /= np.linalg.norm(normal)
    residual, whole = circle_parts(measured, normal, given, centre, axis, basis, 1.2)
    flat = np.zeros((5, 6))
    flat[:3, :3], flat[3:, 3:] = np.eye(3), sign * basis.T  # a circle has no front
    expected = 1.2 * flat @ given @ flat.T
    off = np.concatenate([measured - centre, basis.T @ (sign * normal - axis)])
    assert residual == pytest.approx(off, abs=1e-12)
    assert whole == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_another_edge_is_uncertain_along_its_line_of_sight():
    whole, place = covariance_of(np.random.default_rng(6), 5), np.array([0.3, -0.2, 5.0])
    before = whole.copy()
    added = of_other_edge(whole, place) - whole
    assert np.array_equal(whole, before)
    expected = 0.3**2 * np.outer(place, place) + 0.01**2 * (place @ place) * np.eye(3)
    assert added[:3, :3] == pytest.approx(expected, abs=1e-14)
    assert added[3:, 3:] == pytest.approx(0.03**2 * np.eye(2), abs=1e-14)
    assert not added[:3, 3:].any()
