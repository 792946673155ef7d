"""Modelled readings keep the table that was measured on rendered frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.ground.fly.conftest import short_plan

from rendezview.fusion import PoseMeasurement, RangeMeasurement, RingMeasurement
from rendezview.geometry import so3
from rendezview_ground.fly.dynamics import OrbitDynamics
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.sensors import SHARES, ModelledSensors, measured, tilt_moves


def readings(setup, start_m: float, count: int, fault: Fault | None = None):
    """Readings of many seeds at one place, with the truth."""
    plan = short_plan(start_m, 2.0)
    truth = OrbitDynamics(plan, setup.port, 0).start()
    found = []
    for seed in range(count):
        sensors = ModelledSensors(replace(setup, plan=plan), seed, fault)
        found += sensors.read(truth, None)
    return truth, found


def test_the_recognizers_errors_have_the_measured_share_of_their_claims(setup):
    truth, found = readings(setup, 20.0, 400)
    poses = [m for m in found if isinstance(m, PoseMeasurement) and m.sensor == "camera"]
    centre = truth.pose.apply(setup.port.centre_m)
    known = measured()[0]["camera"].at(float(np.linalg.norm(centre)))
    off = np.array([m.pose.apply(setup.port.centre_m) - centre for m in poses])
    turns = np.array([so3.log(m.pose.rotation @ truth.pose.rotation.T) for m in poses])
    claims = np.array([np.sqrt(m.covariance.diagonal()[:3]) for m in poses])
    usual = np.exp(np.log(claims[:, 0]).mean())
    times = claims[:, 0] / usual  # a frame is better or worse than the usual one, in all at once
    share = known.sigma / known.claimed
    assert usual == pytest.approx(known.claimed[0], rel=0.1)
    np.testing.assert_allclose(np.quantile(np.log(times), SHARES), known.scatter, atol=0.15)
    # By medians: a wild reading is none of these.
    worse = (times ** (known.follows - 1.0))[:, None]
    assert spread((turns / claims)[:, :2] / worse) == pytest.approx(share[0], rel=0.1)
    along = off[:, 2] / times**known.follows
    assert spread(along) == pytest.approx(centre[2] * known.sigma[3], rel=0.15)
    wild = (np.abs(turns / claims) > 5.0).any(axis=1).mean()
    assert wild <= 2.0 * known.wild


def spread(values):
    """σ of normal values that a few wild ones do not change."""
    return np.median(np.abs(values)) / 0.6745


def test_the_table_is_interpolated_between_its_rows():
    table = measured()[0]["camera"]
    k = 4
    known = table.at(table.range_m[k])
    np.testing.assert_allclose([known.sigma, known.claimed], [table.sigma[k], table.claimed[k]])
    between = table.at(float(np.sqrt(table.range_m[k] * table.range_m[k + 1]))).sigma
    np.testing.assert_allclose(between, np.sqrt(table.sigma[k] * table.sigma[k + 1]))


def test_the_reflectors_error_is_the_measured_share_of_their_covariance(setup):
    truth, found = readings(setup, 6.0, 200)
    poses = [m for m in found if m.sensor == "reflectors"]
    known = measured()[0]["reflectors"].at(float(truth.pose.apply(setup.port.centre_m)[2]))
    assert len(poses) == pytest.approx(200 * known.answered, abs=8)
    times = (known.sigma / known.claimed).mean()
    squared = []
    for m in poses:
        turn = so3.log(truth.pose.rotation @ m.pose.rotation.T)
        off = np.r_[turn, truth.pose.translation_m - m.pose.translation_m]
        squared.append(off @ np.linalg.solve(m.covariance, off))
    assert np.mean(squared) == pytest.approx(6.0 * times**2, rel=0.15)


def middle(radius_m, place, normal):
    """Of a circle's ellipse, in the plane at 1: of its points, by least squares."""
    side = np.cross(normal, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0.0, 2.0 * np.pi, 90)[:, None]
    points = place + radius_m * (np.cos(angle) * side + np.sin(angle) * np.cross(normal, side))
    x, y = (points[:, :2] / points[:, 2:]).T
    a, b, c, d, e = np.linalg.lstsq(
        np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)), rcond=None
    )[0]
    return np.linalg.solve([[2.0 * a, b], [b, 2.0 * c]], [-d, -e])


def test_a_ring_that_is_taken_for_tilted_is_taken_for_elsewhere_so_that_its_middle_stays():
    radius_m, centre, axis = 0.6, np.array([0.05, -0.03, 1.5]), np.array([0.0, 0.0, -1.0])

    tilted = axis + np.array([0.04, 0.03, 0.0])
    tilted /= np.linalg.norm(tilted)
    moved = centre + tilt_moves(centre, radius_m) @ (tilted - axis)
    there, stayed = middle(radius_m, centre, axis), middle(radius_m, centre, tilted)
    off = np.linalg.norm(middle(radius_m, moved, tilted) - there)
    assert off < 0.1 * np.linalg.norm(stayed - there)


def test_both_circles_of_a_modelled_ring_have_one_ellipse(setup):
    radius_m = setup.port.ring.radius_m
    _, found = readings(setup, 2.0, 40)
    rings = [m for m in found if isinstance(m, RingMeasurement)]
    assert len(rings) > 20
    off, apart = [], []
    for ring in rings:
        (place, other), (normal, mirrored) = ring.centres_m, ring.axes
        seen = middle(radius_m, place, normal)
        off.append(np.linalg.norm(middle(radius_m, other, mirrored) - seen))
        apart.append(np.linalg.norm(middle(radius_m, place, mirrored) - seen))
    assert np.median(off) < 0.1 * np.median(apart)


@pytest.mark.parametrize("kind", ["camera", "ring", "laser", "reflectors", "glare"])
def test_a_fault_strikes_its_sensor(setup, kind: str):
    drawn = Fault.drawn(kind, 0)
    size = 1600.0 if kind == "glare" else drawn.size
    fault = Fault(kind, 0.0, 100.0, size)
    truth, good = readings(setup, 5.0, 30)
    _, bad = readings(setup, 5.0, 30, fault)

    def of(found, sensor):
        return [m for m in found if m.sensor == sensor]

    if kind == "camera":
        assert {m.sensor for m in bad} <= {"gyro", "laser", "thrust"}
    elif kind == "glare":
        assert len(of(bad, "camera")) < len(of(good, "camera"))
    elif kind == "reflectors":
        assert of(good, "reflectors")
        assert not of(bad, "reflectors")
    elif kind == "laser":
        pairs = zip(of(good, "laser"), of(bad, "laser"), strict=True)
        assert all(
            isinstance(g, RangeMeasurement) and b.range_m - g.range_m == pytest.approx(0.3)
            for g, b in pairs
        )
    else:
        centre = truth.pose.apply(setup.port.centre_m)
        rings = [m for m in bad if isinstance(m, RingMeasurement)]
        ratios = [m.centres_m[0][2] / centre[2] for m in rings]
        assert np.mean(ratios) == pytest.approx(1.08, abs=0.01)
