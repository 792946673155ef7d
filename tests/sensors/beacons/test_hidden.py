"""Hidden reflectors, several poses of the same spots, hand-over: on the plain simulator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.plain_pictures import Look, look_at
from tests.plain_readings import HALF_TURN, PAPER, frames_of

from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import (
    Acquirer,
    ReflectorSensor,
    SixNumbers,
    TrackingOptions,
    find_spots,
    patterns_of,
    pose_of,
    predict_spots,
)
from rendezview.sensors.beacons.constellation import left_out_of
from rendezview.sensors.beacons.detect.background import Background
from rendezview.sensors.beacons.detect.discs import expected_size
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS, SIGMA, SIZE
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.match.judgement import common_variance, least_facing
from rendezview.sensors.beacons.match.matching import match_all, match_spots, size_score
from rendezview.sensors.beacons.match.mirrored_pose import mirror
from rendezview.sensors.beacons.window_fit import WindowFit
from rendezview.sensors.observation import Status


def wrong(pose, truth):
    return min(pose.angle_to(truth), pose.angle_to(truth @ HALF_TURN)) > math.radians(5.0)


def test_neighbours_names_make_a_reading_ambiguous_and_not_a_wrong_pose(client, paper_camera):
    patterns = patterns_of(client)
    target = merged(patterns)
    names = {name: k for k, name in enumerate(target.names)}
    pose = pose_of(SixNumbers(6.0, 0.0, 0.1, 0.0, 0.0, 0.0), patterns[0])
    table = np.full((len(target), COLUMNS), np.nan)
    table[:, :2], table[:, SIGMA] = predict_spots(paper_camera, target, pose)[:, :2], 0.02
    options = AcquisitionOptions()
    fit = WindowFit(paper_camera, target, options, TrackingOptions(), Background())
    everything = np.arange(len(target))
    found, kept = fit.without_strangers(pose, fit.solve(pose, table, everything), table, everything)
    assert found is not None
    assert len(kept) == len(target)
    # The windows moved by one reflector of the near group.
    taken, own = (
        [names["near-middle"], names["near-right"]],
        [names["near-left"], names["near-middle"]],
    )
    table[taken] = table[own]
    seen = np.array(sorted(k for name, k in names.items() if name != "near-left"))
    found, kept = fit.without_strangers(pose, fit.solve(pose, table, seen), table, seen)
    assert found is None
    assert len(kept) == 0


def test_the_plain_simulator_and_the_sensor_agree_on_where_a_disc_is(five, paper_camera):
    rng = np.random.default_rng(0)
    for _ in range(5):
        pose = Pose(*look_at(rng, PAPER, rng.uniform(1.5, 6.0), 0.5, 130.0))
        frames = frames_of(PAPER, five, pose, rng, Look(noise=0.0))
        spots = find_spots(frames).centroids_px
        wanted = predict_spots(paper_camera, five, pose)
        apart = np.linalg.norm(wanted[:, None] - spots[None], axis=2).min(axis=1)
        assert apart.max() < 0.01


@pytest.mark.requirement("RV-REFL-1")
@pytest.mark.parametrize("hidden", [(1, 0), (1, 2), (1, 3), (0, 3)])
def test_three_of_five_are_never_a_wrong_pose(five, paper_camera, hidden):
    rng = np.random.default_rng(1)
    acquirer, statuses = Acquirer(paper_camera, [five]), []
    for _ in range(12):
        pose = Pose(*look_at(rng, PAPER, rng.uniform(1.5, 6.0), 0.5, 130.0))
        found = acquirer.acquire(find_spots(frames_of(PAPER, five, pose, rng, hidden=hidden)))
        statuses.append(found.status)
        if found.refined is not None:
            assert not wrong(found.refined.camera_from_target, pose)
    assert Status.AMBIGUOUS in statuses


def test_the_other_poses_of_the_same_spots_make_it_ambiguous_and_a_prior_chooses(
    five, paper_camera
):
    rng = np.random.default_rng(2)
    pose = pose_of(SixNumbers(3.0, 0.03, -0.02, 0.2, 0.3, -0.2), five)
    spots = find_spots(frames_of(PAPER, five, pose, rng, hidden=(1, 2)))
    acquirer = Acquirer(paper_camera, [five])
    found = acquirer.acquire(spots)
    assert found.status is Status.AMBIGUOUS
    assert "poses show the same 3 spots" in found.reason
    chosen = acquirer.acquire(spots, pose.perturbed([0.02, -0.03, 0.02, 0.0, 0.0, 0.05]))
    assert chosen.refined.camera_from_target.angle_to(pose) < 0.02


def test_a_wrong_track_is_left_within_three_readings_of_all_reflectors_in_view(five, paper_camera):
    rng = np.random.default_rng(3)
    truth = pose_of(SixNumbers(3.0, 0.03, -0.02, 0.2, 0.35, -0.2), five)
    seen = np.array([0, 2, 3])
    false = mirror(truth, five, seen)
    sensor = ReflectorSensor(paper_camera, [five])
    sensor.start(0.0, false)
    statuses = []
    for k in range(1, 9):
        hidden = (1, 4) if k < 5 else ()
        reading = sensor.update(0.1 * k, frames_of(PAPER, five, truth, rng, hidden=hidden))
        statuses.append(reading.status)
        if k > 5:
            assert reading.pose is not None
        if reading.pose is not None and k > 4:
            assert not wrong(reading.pose, truth)
    assert Status.AMBIGUOUS in statuses  # that of the reading that says so


def test_an_outer_reflector_that_is_larger_tells_the_roll(three, paper_camera):
    rng = np.random.default_rng(4)
    for ratio in (1.5, 3.0):
        pattern = replace(three, diameters_m=np.array([0.015, 0.015, 0.015 * ratio]))
        for roll in (0.3, 2.8):
            pose = pose_of(SixNumbers(2.0, 0.03, -0.02, roll, 0.1, -0.2), three)
            found = Acquirer(paper_camera, [pattern]).acquire(
                find_spots(frames_of(PAPER, pattern, pose, rng))
            )
            assert found.status is Status.OK, found.reason
            assert not found.roll_ambiguous
            assert found.refined.camera_from_target.angle_to(pose) < 0.02


def test_scores_of_sizes_are_those_of_numpy():
    rng = np.random.default_rng(5)
    rotation = Rotation.from_rotvec([3.0, 0.1, 0.0]).as_matrix()
    points, normals = rng.normal(0.0, 0.1, (4, 3)), np.tile([0.0, 0.0, 1.0], (4, 1))
    shift, focal, blur = np.array([0.05, -0.02, 2.0]), 650.0, 0.75
    turned = normals @ rotation.T
    places = points @ rotation.T + shift
    cosine = -(turned * places).sum(axis=1) / np.linalg.norm(places, axis=1)
    assert least_facing(rotation, shift, points, normals) == pytest.approx(cosine.min())
    diameters = np.full(4, 0.025)
    sizes = np.empty(4)
    shares = np.empty(4)
    for i, (x, y, z) in enumerate(places):
        slope = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z * focal
        spread = slope @ (np.eye(3) - np.outer(turned[i], turned[i])) @ slope.T
        expected = expected_size(blur, math.sqrt(0.5 * np.trace(spread)) * 0.0125)
        sizes[i], shares[i] = expected * math.exp(rng.normal(0.0, 0.05)), blur / expected
        sizes[i] = max(sizes[i], 1e-3)
        assert common_variance(shares[i], 0.03, 0.1) == pytest.approx(
            ((1 - shares[i] ** 2) * 0.03) ** 2 + (shares[i] ** 2 * 0.1) ** 2
        )
    errors = np.log(sizes * shares / blur)
    common = np.mean([common_variance(s, 0.03, 0.1) for s in shares])
    inverse = np.linalg.inv(0.04**2 * np.eye(4) + common)
    score = size_score(
        points, normals, diameters, rotation, shift, focal, blur, sizes, (0.04, 0.03, 0.1)
    )
    assert score == pytest.approx(errors @ inverse @ errors, rel=1e-9)


def test_all_poses_are_matched_as_each_alone(five, paper_camera):
    from rendezview.sensors.beacons.detect.discs import camera_numbers

    lens = camera_numbers(paper_camera, 0.75)
    poses = [pose_of(SixNumbers(r, 0.0, 0.0, 0.2, 0.1, 0.1), five) for r in (3.0, 3.05)]
    table = np.zeros((5, COLUMNS))
    table[:, :2] = predict_spots(paper_camera, five, poses[0])[::-1]
    table[:, SIZE] = 1.6
    shared = (lens, five.positions_m, five.normals, five.diameters_m)
    which, where = np.empty((2, 5), np.int64), np.empty((2, 5), np.int64)
    counts, orders = np.empty(2, np.int64), np.tile(np.arange(5)[::-1], (2, 1))
    numbers = np.array([np.append(p.rotation.ravel(), p.translation_m) for p in poses])
    match_all(
        *shared, numbers, 652.0, 0.75, orders, table, np.arange(5), np.tile([4, 3, 2], (2, 1)),
        (1.5, 0.28), counts, which, where,
    )  # fmt: skip
    for k, pose in enumerate(poses):
        names, places = np.empty(5, np.int64), np.empty(5, np.int64)
        count = match_spots(
            *shared, np.ascontiguousarray(pose.rotation), pose.translation_m, 652.0, 0.75,
            orders[k], table, np.arange(5), np.array([4, 3, 2]), (1.5, 0.28), names, places,
        )  # fmt: skip
        assert counts[k] == count
        assert which[k, :count].tolist() == sorted(names[:count])
        assert dict(zip(which[k, :count], where[k, :count], strict=True)) == dict(
            zip(names[:count], places[:count], strict=True)
        )
    assert counts[0] == 5


def test_near_by_a_beam_and_the_tilt_make_discs_unlike_and_all_are_found(
    picture, three, paper_camera
):
    """At 0.8 m the outer discs are half as bright as the post's, and one 1.4 times the other."""
    rng = np.random.default_rng(3)
    for _ in range(12):
        truth = Pose(*look_at(rng, PAPER, 0.8, 0.5, 187.0))
        sensor, reading = ReflectorSensor(paper_camera, [three]), None
        for k in range(2):
            reading = sensor.update(0.1 * k, picture(three, truth, rng))
        assert reading.status is Status.OK
        assert min(reading.pose.angle_to(truth), reading.pose.angle_to(truth @ HALF_TURN)) < 0.01


def client_far_off(range_m, patterns):
    """A pose of the client, its far group on the boresight."""
    truth = pose_of(SixNumbers(range_m, 0.0, 0.0, 0.0, 0.05, -0.04), patterns[1])
    aim = truth.apply(patterns[0].centre_m)
    turn = Rotation.from_rotvec([math.atan2(aim[1], aim[2]), -math.atan2(aim[0], aim[2]), 0.0])
    return Pose(turn.as_matrix(), np.zeros(3)) @ truth


def test_with_a_neighbour_hidden_the_others_keep_their_names(client, picture, paper_camera):
    """Far off, one of the client's near reflectors is hidden: the other two could be any two."""
    patterns = patterns_of(client)
    both, rng = merged(patterns), np.random.default_rng(105)
    known = 0
    for n in range(24):
        truth = client_far_off(7.6 + 0.02 * n, patterns)
        spots = find_spots(picture(both, truth, rng, hidden=(3,)))
        found = Acquirer(paper_camera, patterns).acquire(spots)
        if found.refined is not None and not found.roll_ambiguous:
            assert found.refined.camera_from_target.angle_to(truth) < 0.03
            known += 1
    assert known >= 15


def test_a_roll_that_happens_to_be_right_is_known_once_the_near_group_was_seen_twice(
    client, picture, paper_camera
):
    patterns = patterns_of(client)
    both, rng = merged(patterns), np.random.default_rng(106)
    # The near group 2.8 m away would look the same: the operator knows that it is farther.
    options = AcquisitionOptions(nearest_m=4.0)
    sensor, open_ = ReflectorSensor(paper_camera, patterns, acquisition=options), []
    for n in range(6):
        truth = client_far_off(7.0 - 0.02 * n, patterns)
        hidden = (3, 4, 5) if n < 3 else ()  # the near group comes into view
        reading = sensor.update(0.5 * n, picture(both, truth, rng, hidden=hidden))
        if n:
            assert reading.pose.angle_to(truth) < 0.03  # the roll nearest to level, which is right
            open_.append(reading.roll_ambiguous)
    assert open_[:2] == [True, True]
    assert not open_[-1]


def test_discs_as_faint_as_the_threshold_are_found(picture, three, paper_camera):
    """They fall to pieces at the threshold of single pixels."""
    rng = np.random.default_rng(3)
    sensor = ReflectorSensor(paper_camera, [three], tracking=TrackingOptions(confirm=False))
    in_pieces = 0
    for _ in range(12):
        truth = Pose(*look_at(rng, PAPER, 0.8, 0.5, 187.0))
        frames = picture(three, truth, rng, peak_grey=40.0)
        in_pieces += (
            Acquirer(paper_camera, [three]).acquire(find_spots(frames)).status is Status.NOT_FOUND
        )
        sensor.forget()
        reading = sensor.update(0.0, frames)
        assert reading.status is Status.OK
        assert not wrong(reading.pose, truth)
    assert in_pieces >= 3


@pytest.mark.parametrize(
    ("given", "there", "range_m", "status"),
    [
        ("near", "far", 8.0, Status.OK),  # dots too small to tell: a note says so
        ("near", "far", 4.0, Status.AMBIGUOUS),
        ("near", "far", 1.2, Status.AMBIGUOUS),
        ("far", "near", 2.0, Status.AMBIGUOUS),
        ("far", "near", 0.5, Status.AMBIGUOUS),
        ("far", "near", 0.3, Status.AMBIGUOUS),  # nearer than the named group would be looked for
        ("far", "far", 4.0, Status.OK),
        ("near", "near", 0.6, Status.OK),
    ],
)
def test_a_group_that_is_left_out_is_not_read_as_the_named_one(
    client, paper_camera, given, there, range_m, status
):
    seen, named = (patterns_of(client, (name,)) for name in (there, given))
    options = AcquisitionOptions(left_out=left_out_of(client, named))
    sensor = ReflectorSensor(paper_camera, named, acquisition=options)
    rng = np.random.default_rng(3)
    pose = pose_of(SixNumbers(range_m, 0.02, -0.03, 0.3, 0.1, -0.05), seen[0])
    for k in range(6):
        reading = sensor.update(0.1 * k, frames_of(PAPER, seen[0], pose, rng))
    assert reading.status is status
    if given != there:
        assert f"the group {there!r}, which is left out" in (reading.reason or reading.note)


def test_a_group_that_is_left_out_is_compared_again_as_the_target_comes_nearer(
    client, paper_camera
):
    far, near = patterns_of(client)
    ends = {}
    for named, seen, first_m, last_m in ((near, far, 10.0, 4.0), (far, far, 10.0, 4.0)):
        options = AcquisitionOptions(left_out=left_out_of(client, [named]))
        sensor = ReflectorSensor(paper_camera, [named], acquisition=options)
        rng, readings = np.random.default_rng(3), []
        for k, range_m in enumerate(np.geomspace(first_m, last_m, 24)):
            pose = pose_of(SixNumbers(range_m, 0.02, -0.03, 0.3, 0.1, -0.05), seen)
            readings.append(sensor.update(0.1 * k, frames_of(PAPER, seen, pose, rng)))
        assert "which is left out, fits these spots as well" in readings[2].note
        ends[named.name] = readings[-1]
    assert ends["near"].pose is None
    assert "the group 'far', which is left out" in ends["near"].reason
    assert ends["far"].pose is not None
    assert ends["far"].note is None
