"""Frame by frame: the follower, and CCSDS messages through another reader."""

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime

import numpy as np
import pytest
from oem import OrbitEphemerisMessage
from scipy.spatial.transform import Rotation
from tests.trajectory.closed_loop import FlightErrors, fly
from tests.trajectory.paths import circle, off

from rendezview.geometry.pose import Pose
from rendezview.io.ccsds import attitude_message, orbit_message
from rendezview.trajectory import (
    Correction,
    FollowerOptions,
    NoFit,
    Orbit,
    PathFollower,
    Plan,
    Segment,
    Shape,
    Spin,
)
from rendezview.trajectory.follower import record
from rendezview_ground.simulate.trajectories import looking_at

CENTRE = np.array([0.5, -1.0, 2.0])
TIMES = np.linspace(0.0, 400.0, 101)
COVARIANCE = np.diag([1e-6] * 3 + [1e-4] * 3)


def flown(rng):
    """Poses of two radians of a circle about the centre, and its normal."""
    turn, first, second = circle(rng)
    places = np.concatenate([first[::2], second[2::2]]) + CENTRE
    poses = [looking_at(place, CENTRE, turn[:, 2]) for place in places]
    root = np.sqrt(np.diag(COVARIANCE))
    return turn, places, [pose.perturbed(root * rng.standard_normal(6)) for pose in poses]


def plan_of(turn, **more):
    numbers = {"radius_m": 30.0, "rate_rad_s": 1.0 / 200.0, "frame": turn}
    return Plan(shape=Shape.CIRCULAR, kind="circular", numbers=numbers, **more)


def test_segments_of_a_radian_end_and_each_is_compared_with_the_plan():
    rng = np.random.default_rng(1)
    turn, places, poses = flown(rng)
    follower = PathFollower(CENTRE, plan=plan_of(turn))
    reports = [follower.update(t, pose, COVARIANCE) for t, pose in zip(TIMES, poses, strict=True)]
    assert not reports[3].segment
    assert sum(report.ended for report in reports) == 2 or reports[-1].number == 1
    last = reports[-1]
    assert isinstance(last.segment, Segment)
    assert last.segment.start_s == pytest.approx(200.0, abs=8.0)
    assert off(last.segment.places(TIMES[60:]) + CENTRE, places[60:]) < 5e-4
    assert isinstance(last.correction, Correction)
    assert np.linalg.norm(last.correction.error_m) < 0.02
    assert isinstance(last.spin, Spin)
    # The camera goes round the target, so in its line of sight the target turns the other way.
    assert last.spin.axis @ turn[:, 2] < -0.999
    assert record(last)["segment"]["shape"] == "circular"


def test_both_moving_the_chasers_attitude_tells_spin_and_path():
    rng = np.random.default_rng(2)
    _, places, _ = flown(rng)
    rate = np.array([0.001, 0.004, -0.002])
    body = Rotation.from_rotvec(TIMES[:, None] * rate).as_matrix()  # path from target
    follower = PathFollower(CENTRE, Shape.CIRCULAR)
    for k, t in enumerate(TIMES):
        # The path is about the centre and keeps to its own axes while the target turns in them.
        about = places[k] - CENTRE
        path_from_camera = looking_at(about, np.zeros(3), [0.3, 0.2, 0.9]).rotation.T
        rotation = path_from_camera.T @ body[k]
        pose = Pose(rotation, -path_from_camera.T @ about - rotation @ CENTRE)
        noisy = pose.perturbed(np.sqrt(np.diag(COVARIANCE)) * rng.standard_normal(6))
        report = follower.update(t, noisy, COVARIANCE, path_from_camera=path_from_camera)
    assert isinstance(report.segment, Segment)
    assert off(report.segment.places(TIMES[60:]), places[60:] - CENTRE) < 1e-3
    assert isinstance(report.spin, Spin)
    np.testing.assert_allclose(report.spin.rate_rad_s, rate, atol=2e-5)


def test_on_nodes_alone_are_followed():
    rng = np.random.default_rng(3)
    _, places, _ = flown(rng)
    follower = PathFollower(CENTRE, Shape.CIRCULAR, options=FollowerOptions(poses=False))
    for t, place in zip(TIMES, places, strict=True):
        cloud = place + 2.0 * rng.standard_normal((5, 3))
        report = follower.update(t, points_m=cloud, weights=np.ones(5))
    assert isinstance(report.segment, Segment)
    assert off(report.segment.places(TIMES[60:]) + CENTRE, places[60:]) < 0.02


def test_nonsense_is_answered_with_a_reason_and_forgotten():
    rng = np.random.default_rng(4)
    turn, _, poses = flown(rng)
    follower = PathFollower(CENTRE, plan=plan_of(turn))
    for t, pose in zip(TIMES[:40], poses[:40], strict=True):
        follower.update(t, pose, COVARIANCE)
    for time_s, points, words in (
        (TIMES[10], None, "do not rise"),
        (np.nan, None, "not finite"),
        (TIMES[40], np.full((4, 3), np.nan), "a point is not finite"),
    ):
        report = follower.update(time_s, poses[40], COVARIANCE, points, np.ones(4))
        assert isinstance(report.segment, NoFit)
        assert words in report.segment.reason
        assert record(report)["segment"] is None
    assert follower.update(TIMES[41], poses[41], COVARIANCE).segment


CLOUDS = {
    "one place": [[30.0, 0.0, 0.0]] * 12,
    "a line": [[30.0 - k, 0.0, 0.0] for k in range(12)],
    "two places": [[30.0 - k % 2, 0.0, 0.0] for k in range(12)],
    "far away": [[1e9, 0.0, 1e3 * k] for k in range(12)],
    "hardly moving": [[30.0, 0.0, 1e-9 * k] for k in range(12)],
    "a jump": [[30.0, 0.0, 0.0]] * 6 + [[-30.0, 50.0, 0.0]] * 6,
}


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize("cloud", CLOUDS)
def test_degenerate_clouds_give_no_number_that_is_not_finite(shape, cloud):
    follower = PathFollower(np.zeros(3), shape=shape)
    for k, place in enumerate(CLOUDS[cloud]):
        report = follower.update(float(k), Pose(np.eye(3), np.array(place)), COVARIANCE)
    if isinstance(report.segment, Segment):
        assert np.isfinite(report.segment.places(np.arange(12.0))).all()
        assert np.isfinite(report.segment.parameters).all()
    else:
        assert report.segment.reason


def test_a_camera_at_the_centre_of_the_path_has_no_line_of_sight():
    follower = PathFollower(np.zeros(3), shape=Shape.SPIRAL)
    told = follower.update(0.0, Pose(np.eye(3), np.zeros(3)), COVARIANCE)
    assert "no line of sight" in told.segment.reason
    follower.update(1.0, Pose(np.eye(3), np.array([0.0, 0.0, 5.0])), COVARIANCE)
    assert len(follower.cloud) == 1


def test_a_follower_wants_a_shape_or_a_plan():
    with pytest.raises(ValueError, match="shape or a plan"):
        PathFollower(CENTRE)
    with pytest.raises(ValueError, match="turn_rad"):
        FollowerOptions(turn_rad=4.0)


def test_corrections_hold_a_flight_to_its_plan():
    plan = plan_of(
        np.eye(3), orbit=Orbit(0.0011, np.eye(3)), deviation=True, segment_s=200.0, end_s=1200.0
    )
    plan = Plan(
        shape=Shape.DRIFT, kind=plan.kind, numbers=plan.numbers, end_s=1200.0, orbit=plan.orbit,
        segment_s=200.0, deviation=True,
    )  # fmt: skip
    options = FollowerOptions(turn_rad=None, segment_s=100.0, spin=False)
    follower = PathFollower(CENTRE, plan=plan, options=options)
    noise = np.random.default_rng(6)

    def look(_: float, pose: Pose):
        found = pose.perturbed(np.sqrt(np.diag(COVARIANCE)) * noise.standard_normal(6))
        return found, COVARIANCE, np.zeros((0, 3)), np.zeros(0)

    steps = {"step_s": 10.0, "end_s": 1190.0}
    errors = FlightErrors()
    corrected = fly(
        plan, CENTRE, errors, np.random.default_rng(5), look=look, follower=follower, **steps
    )
    alone = fly(plan, CENTRE, errors, np.random.default_rng(5), **steps)
    assert corrected.corrections > 10
    assert alone.rms_m > 10.0 * corrected.rms_m


def test_a_flight_without_errors_keeps_to_its_plan():
    plan = plan_of(np.eye(3), orbit=Orbit(0.0011, np.eye(3)))
    perfect = FlightErrors(
        place_m=0, velocity_m_s=0, thrust_scale=0, thrust_scale_each=0, thrust_askew_rad=0,
        drag_m_s2=0,
    )  # fmt: skip
    flight = fly(plan, CENTRE, perfect, np.random.default_rng(1), step_s=10.0, end_s=1200.0)
    assert flight.rms_m < 1e-6


def test_the_orbit_message_is_read_by_another_reader(tmp_path):
    rng = np.random.default_rng(7)
    times = np.arange(5) * 2.5
    places, speeds = 30.0 * rng.standard_normal((5, 3)), rng.standard_normal((5, 3))
    epoch = datetime(2021, 5, 4, 12, tzinfo=UTC)
    path = tmp_path / "path.oem"
    path.write_text(orbit_message(epoch, times, places, speeds, frame="RSW_ROTATING"))
    states = OrbitEphemerisMessage.open(path).states
    np.testing.assert_allclose([s.position * 1000.0 for s in states], places, atol=1e-6)
    np.testing.assert_allclose([s.velocity * 1000.0 for s in states], speeds, atol=1e-9)
    assert states[1].epoch.isot.rstrip("0") == "2021-05-04T12:00:02.5"
    assert (states[0].frame, states[0].center) == ("RSW_ROTATING", "TARGET")


def test_covariances_of_the_orbit_message_are_read_by_another_reader(tmp_path):
    rng = np.random.default_rng(8)
    times, roots = np.arange(4) * 2.5, rng.standard_normal((4, 6, 6))
    spreads = roots @ roots.transpose(0, 2, 1)
    path = tmp_path / "path.oem"
    path.write_text(
        orbit_message(
            datetime(2021, 5, 4, 12, tzinfo=UTC), times, np.ones((4, 3)), np.ones((4, 3)),
            frame="RSW_ROTATING", covariances=spreads,
        )
    )  # fmt: skip
    found = list(OrbitEphemerisMessage.open(path).covariances)
    np.testing.assert_allclose([1e6 * c.matrix for c in found], spreads, rtol=1e-8)
    assert [c.epoch.isot[17:20] for c in found] == ["00.", "02.", "05.", "07."]
    assert {c.frame for c in found} == {"RSW_ROTATING"}


def test_the_attitude_message_keeps_its_signs_and_its_sense():
    turns = Rotation.from_rotvec(np.linspace(0.0, 6.0, 40)[:, None] * [0.0, 0.0, 1.0])
    text = attitude_message(
        datetime(2021, 5, 4, tzinfo=UTC), np.arange(40.0), turns.as_matrix(), frame="ICRF"
    )
    data = text.split("DATA_START\n")[1].split("DATA_STOP")[0].splitlines()
    quats = np.array([[float(word) for word in line.split()[1:]] for line in data])
    assert np.all(np.sum(quats[1:] * quats[:-1], axis=1) > 0.9)
    # Scalar last, about +z by the angle: the frame A turned into B.
    np.testing.assert_allclose(np.abs(quats[1]), [0, 0, np.sin(3 / 39), np.cos(3 / 39)], atol=1e-9)
    assert quats[1, 2] * quats[1, 3] > 0.0


@pytest.mark.parametrize("times", [[], [0.0, 0.0], [0.0, np.nan]])
def test_an_ephemeris_of_nothing_is_refused(times):
    with pytest.raises(ValueError, match=r"ephemeris"):
        orbit_message(
            datetime(2021, 5, 4, tzinfo=UTC), times, np.zeros((len(times), 3)),
            np.zeros((len(times), 3)), frame="RSW_ROTATING",
        )  # fmt: skip


def test_threads_get_what_one_thread_gets():
    turn, _, poses = flown(np.random.default_rng(9))

    def run() -> list[bytes]:
        follower = PathFollower(CENTRE, plan=plan_of(turn))
        reports = [
            follower.update(t, pose, COVARIANCE)
            for t, pose in zip(TIMES[:40], poses[:40], strict=True)
        ]
        return [
            report.segment.parameters.tobytes() + report.segment.covariance.tobytes()
            for report in reports
            if isinstance(report.segment, Segment)
        ]

    alone = run()
    assert len(alone) > 20
    with ThreadPoolExecutor(3) as pool:
        assert all(future.result() == alone for future in [pool.submit(run) for _ in range(3)])


def test_one_follower_in_two_threads_answers_one_call_after_the_other():
    turn, _, poses = flown(np.random.default_rng(10))
    follower, order = PathFollower(CENTRE, plan=plan_of(turn)), iter(range(30))
    turns = threading.Lock()

    def work() -> int:
        done = 0
        while True:
            with turns:  # times must rise
                k = next(order, None)
                if k is None:
                    return done
                follower.update(TIMES[k], poses[k], COVARIANCE)
            done += 1

    with ThreadPoolExecutor(2) as pool:
        assert sum(future.result() for future in [pool.submit(work) for _ in range(2)]) == 30
    assert len(follower.cloud) == 30
