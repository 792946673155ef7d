"""Groups that are said not to be there, on the plain simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.plain_readings import PAPER, frames_of

from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import (
    Acquirer,
    ReflectorPattern,
    ReflectorSensor,
    SixNumbers,
    find_spots,
    patterns_of,
    pose_of,
)
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.observation import Status


@pytest.fixture(scope="module")
def groups(client):
    return {pattern.name: pattern for pattern in patterns_of(client)}


def at(pattern, range_m):
    return pose_of(SixNumbers(range_m, 0.02, -0.03, 0.3, 0.1, -0.05), pattern)


@pytest.mark.parametrize(("back_m", "status"), [(8.0, Status.OK), (6.0, Status.AMBIGUOUS)])
def test_a_group_that_is_left_out_is_compared_when_the_target_is_found_again(
    paper_camera, groups, back_m, status
):
    """The near group is named and the far one is there: at 8 m their spots look the same."""
    far, near = groups["far"], groups["near"]
    sensor = ReflectorSensor(paper_camera, [near], acquisition=AcquisitionOptions(left_out=(far,)))
    rng = np.random.default_rng(4)
    for k in range(3):
        reading = sensor.update(0.1 * k, frames_of(PAPER, far, at(far, 8.0), rng))
    assert reading.status is Status.OK
    for k in range(3, 12):  # covered for longer than windows are kept, and nearer meanwhile
        reading = sensor.update(0.1 * k, frames_of(PAPER, far, at(far, 8.0), rng, hidden=(0, 1, 2)))
    assert reading.pose is None
    assert not sensor.is_tracking
    reading = sensor.update(1.2, frames_of(PAPER, far, at(far, back_m), rng))
    assert reading.status is status
    assert "the group 'far', which is left out" in (reading.reason or reading.note)


def test_every_group_that_fits_as_well_is_told(paper_camera, groups):
    far, near = groups["far"], groups["near"]
    options = AcquisitionOptions(left_out=(far, replace(far, name="twin")))
    frames = frames_of(PAPER, far, at(far, 8.0), np.random.default_rng(4))
    found = Acquirer(paper_camera, [near], options).acquire(find_spots(frames))
    assert found.status is Status.OK
    assert "'far'" in found.note
    assert "'twin'" in found.note


def test_a_group_that_is_left_out_counts_though_two_of_its_poses_show_the_spots(paper_camera):
    """Three reflectors in a plane: the last pose chooses for the named group, not for the other."""
    places = np.array([[-0.2, 0.0, 0.0], [0.03, 0.12, 0.0], [0.2, 0.0, 0.0]])
    names, normals = ("left", "centre", "right"), np.tile([0.0, 0.0, 1.0], (3, 1))
    there = ReflectorPattern("there", names, places, normals, np.full(3, 0.030))
    named = ReflectorPattern("named", names, 0.5 * places, normals, np.full(3, 0.0165))
    pose = pose_of(SixNumbers(2.0, 0.02, -0.03, 0.3, 0.22, -0.2), there)
    spots = find_spots(frames_of(PAPER, there, pose, np.random.default_rng(4)))
    half = Pose(pose.rotation, 0.5 * pose.translation_m)
    assert Acquirer(paper_camera, [there]).acquire(spots).status is Status.AMBIGUOUS
    assert Acquirer(paper_camera, [named]).acquire(spots, half).status is Status.OK
    options = AcquisitionOptions(left_out=(there,))
    found = Acquirer(paper_camera, [named], options).acquire(spots, half)
    assert found.refined is None
    assert "the group 'there', which is left out" in found.reason
