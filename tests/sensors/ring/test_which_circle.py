"""Which of a vehicle's concentric circles is the ring's: by a range, by their pattern, or open."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.sequences.frame import Frame
from rendezview.sensors.observation import Status
from rendezview.sensors.ring import Ellipse, RingPrior, RingSensor, shape_of_circle
from rendezview.sensors.ring.detector import Detection, RingEdge
from rendezview.sensors.ring.prior_log import priors_of_poses
from rendezview.sensors.ring.which_circle import RING, Knowledge, which_circle
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.simulate.scene import SceneOptions, render_frame, sun_at_phase

CAMERA = Camera.from_fov(640, 480, math.radians(40.0))
RADIUS_M = 0.6
CIRCLES = ((-0.25, 0.71), (-0.25, 0.645), (-0.25, 0.44), (0.0, 0.56))
CENTRE_M = np.array([0.1, -0.2, 6.0])
TRUE = 1  # index of the ring's edge among those of `edges`


def edges(tilt_rad: float, scores=(1.0, 0.4, 0.8, 0.9, 0.4)) -> list[RingEdge]:
    """The foot, the ring, the cone, a shield and the ring's inner edge; the foot is seen best."""
    axis = np.array([math.sin(tilt_rad), 0.0, -math.cos(tilt_rad)])
    found = []
    for score, (height_m, radius_m) in zip(
        scores, ((-0.25, 0.71), (0.0, RADIUS_M), *CIRCLES[1:]), strict=True
    ):
        shape = shape_of_circle(CAMERA, CENTRE_M + height_m * axis, axis, radius_m)
        ellipse = Ellipse.from_shape(shape, 1e-3 * np.eye(5))
        found.append(RingEdge(ellipse, math.tau * score, score, 50.0, 0, 0.05))
    return found


def by_range(found, range_m, sigma_m, circles=()):
    known = Knowledge(RADIUS_M, circles, range_m=range_m, range_sigma_m=sigma_m)
    return which_circle(CAMERA, found, known)


def test_a_range_chooses_the_ring_and_not_the_best_seen_circle():
    for tilt in (0.02, 0.3):
        found = edges(tilt)
        assert by_range(found, 6.08, 0.06).edge == TRUE
        assert by_range(found, 5.3, 0.05).edge == 0  # a range that is the foot's


def test_circles_of_nearly_the_range_are_rivals_and_named():
    found = edges(0.3)
    which = by_range(found, 5.9, 0.1)  # the cone's would be at 5.8 m
    assert {(which.edge, RING), *which.rivals} == {(TRUE, RING), (2, RING)}
    assert "5.8" in which.reason
    assert "6.0" in which.reason
    assert by_range(found, 40.0, 0.4).edge is None


def test_a_circle_that_a_range_hardly_fits_is_no_better_than_a_chance_one():
    found = edges(0.3)[TRUE::3]  # the ring's own
    assert not by_range(found, 6.0, 0.18).doubtful
    hardly = by_range(found, 6.0 / 1.078, 0.18)  # 2.4 σ: so do other circles of a vehicle
    assert (hardly.edge, hardly.rivals, hardly.doubtful) == (0, (), True)
    assert "does not tell whether" in hardly.reason


def test_a_range_that_is_wrong_does_not_outweigh_the_pattern_of_the_circles():
    """A filter that is sure and 2 % off left a chance ellipse alone, which was given."""
    axis = np.array([-0.2, 0.1, -1.0]) / math.sqrt(1.05)
    shape = shape_of_circle(CAMERA, 0.98 * CENTRE_M, axis, RADIUS_M)
    chance = RingEdge(Ellipse.from_shape(shape, 1e-3 * np.eye(5)), 1.6, 0.5, 50.0, 1, 0.05)
    range_m = 0.98 * float(np.linalg.norm(CENTRE_M))
    which = by_range([*edges(0.3), chance], range_m, 0.02, CIRCLES)
    assert (which.rivals, which.doubtful) == ((), False)
    assert np.linalg.norm(which.centre_m - CENTRE_M) < 0.002


def test_the_pattern_of_known_circles_needs_no_range():
    for tilt in (0.02, 0.3, 0.6):
        which = which_circle(CAMERA, edges(tilt), Knowledge(RADIUS_M, CIRCLES))
        assert (which.rivals, which.doubtful) == ((), False)
        assert which.edge == [0, TRUE, 2, 3, 4][(0, RING, 1, 2, 3).index(which.circle)]
        assert np.linalg.norm(which.centre_m - CENTRE_M) < 0.002


def test_without_a_range_and_a_pattern_the_choice_is_open():
    head_on = which_circle(CAMERA, edges(0.02), Knowledge(RADIUS_M))
    assert (TRUE, RING) in head_on.rivals
    assert "no range" in head_on.reason
    alone = which_circle(CAMERA, edges(0.3)[:1], Knowledge(RADIUS_M))
    assert (alone.edge, alone.rivals, alone.doubtful) == (0, (), True)


@pytest.mark.requirement("RV-RING-2")
def test_an_open_circle_is_no_measurement_and_its_candidates_are_recorded():
    class Given(RingSensor):
        def read(self, prior):
            return self._read(0.0, Detection(tuple(edges(0.3)), 1.0, None), prior)

    ring = find_target("client").docking_ring
    told = RingPrior(axis=np.array([0.3, 0.0, -1.0]), range_m=5.9, range_sigma_m=0.1)
    reading = Given(CAMERA, RADIUS_M).read(told)
    assert reading.status is Status.AMBIGUOUS
    assert reading.circle is None
    assert reading.measurement("ring", ring=ring) is None
    record = reading.record()
    assert record["poses"] == []
    assert sorted(c["ellipse"] for c in record["candidates"]) == [TRUE, 2]
    ranges = [np.linalg.norm(c["poses"][0]["centre_m"]) for c in record["candidates"]]
    assert any(r == pytest.approx(np.linalg.norm(CENTRE_M), rel=1e-3) for r in ranges)
    sure = Given(CAMERA, RADIUS_M, circles=CIRCLES).read(told)
    assert sure.status is Status.OK
    assert sure.record()["candidates"] == []
    assert np.linalg.norm(sure.circle.centre_m - CENTRE_M) < 0.002


def test_a_circle_of_the_right_size_that_stands_alone_is_open_at_first():
    """A ring has two edges; a lone one among other circles may be a rim, or a tank's."""
    groups = (1, 0, 1, 1, 0)

    class Given(RingSensor):
        def read(self, time_s, kept, prior):
            found = [
                replace(edge, group=group) for edge, group in zip(edges(0.3), groups, strict=True)
            ]
            return self._read(time_s, Detection(tuple(found[k] for k in kept), 1.0, None), prior)

    sensor = Given(CAMERA, RADIUS_M)
    axis = np.array([math.sin(0.3), 0.0, -math.cos(0.3)])
    prior = RingPrior(axis=axis, range_m=6.08, range_sigma_m=0.06)
    lone = sensor.read(0.0, (0, TRUE, 2), prior)
    assert (lone.status, lone.edge) == (Status.AMBIGUOUS, 1)
    assert lone.measurement("ring") is None
    assert [one["ellipse"] for one in lone.record()["candidates"]] == [1]
    assert lone.record()["poses"] == []
    assert sensor.read(1.0, (TRUE,), prior).status is Status.OK  # nothing else to confuse it with
    assert sensor.read(2.0, (0, TRUE, 2), prior).status is Status.OK  # it is known by now
    with_inner = Given(CAMERA, RADIUS_M).read(0.0, range(5), prior)
    assert (with_inner.status, with_inner.edge) == (Status.OK, TRUE)


def test_on_frames_of_the_client_the_ring_is_taken_and_not_the_foot():
    target = find_target("client")
    mesh, ring = load_mesh(target.mesh_path, target.unit), target.docking_ring
    for k, (range_m, tilt) in enumerate(((4.7, 0.1), (7.8, 0.35))):
        rng = np.random.default_rng([22, k])
        look = np.array([-math.cos(tilt), math.sin(tilt), 0.0])  # ring → camera
        right = np.cross(look, [0.0, 0.0, 1.0])
        rotation = np.stack([right, np.cross(-look, right), -look])
        pose = Pose(rotation, [0.0, 0.0, range_m] - rotation @ ring.centre_m)
        sun = sun_at_phase(pose.apply(ring.centre_m), 0.4, 1.0 + k)
        image = render_frame(mesh, CAMERA, pose, sun, SceneOptions(), rng)
        for circles, prior in (
            ((), RingPrior(range_m=1.005 * range_m, range_sigma_m=0.01 * range_m)),
            (ring.circles, RingPrior()),
        ):
            reading = RingSensor(CAMERA, ring.radius_m, circles=circles).update(0.0, image, prior)
            assert not reading.rivals
            off = np.linalg.norm(reading.circles[0].centre_m - pose.apply(ring.centre_m))
            assert off < 0.005 * range_m


def no_picture():
    raise AssertionError


def test_a_log_of_poses_gives_the_rings_place_axis_and_error_of_range(tmp_path):
    ring = find_target("client").docking_ring
    sigma = np.diag([0.01, 0.02, 0.0, 0.001, 0.001, 0.03])
    pose = Pose(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), [0.3, 0.1, 9.0])
    quat = Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True)
    line = {"pose": {"quat_wxyz": quat.tolist(), "translation_m": [0.3, 0.1, 9.0]},
            "covariance": (sigma @ sigma).tolist()}  # fmt: skip
    empty = {"im_id": 4, "pose": None, "covariance": None, "time_s": 1.0}
    log = tmp_path / "track.jsonl"
    log.write_text("".join(json.dumps(x) + "\n" for x in (line | {"im_id": 3}, empty)))
    prior = priors_of_poses(log, ring)
    frame = Frame(3, "3", None, CAMERA, None, 1, no_picture)
    known = prior(frame)
    assert known.centre_m == pytest.approx(pose.apply(ring.centre_m))
    assert known.axis == pytest.approx(pose.rotation @ ring.axis)
    draws = np.random.default_rng(1).normal(size=(4000, 6)) @ sigma
    ranges = [np.linalg.norm(pose.perturbed(d).apply(ring.centre_m)) for d in draws]
    assert known.range_sigma_m == pytest.approx(np.std(ranges), rel=0.05)
    assert prior(Frame(4, "4", 1.0, CAMERA, None, 1, no_picture)) is None
    # A log of `fuse` has a line after each sensor: the last of a time is the state by all.
    surer = line | {"covariance": (0.25 * sigma @ sigma).tolist()}
    timed = [x | {"time_s": 2.0} for x in (line, surer)] + [line | {"time_s": 3.0}]
    log.write_text("".join(json.dumps(x) + "\n" for x in timed))
    by_all = priors_of_poses(log, ring)(Frame(5, "5", 2.0, CAMERA, None, 1, no_picture))
    assert by_all.range_sigma_m == pytest.approx(0.5 * known.range_sigma_m)
    log.write_text(json.dumps({"pose": {"a": 1}, "covariance": [[1.0]]}) + "\n")
    with pytest.raises(RendezviewError, match="record 1"):
        priors_of_poses(log, ring)


def test_the_rim_beside_a_hidden_ring_is_the_rim_or_open():
    """Only a rim of 2.5 % more than the ring is visible, at 1 and at 5 σ of the range."""
    rim_m, height_m = 0.615, -0.02
    axis = np.array([math.sin(0.3), 0.0, -math.cos(0.3)])
    shape = shape_of_circle(CAMERA, CENTRE_M + height_m * axis, axis, rim_m)
    found = (RingEdge(Ellipse.from_shape(shape, 1e-3 * np.eye(5)), 6.0, 0.9, 50.0, 0, 0.05),)
    range_m, rim = float(np.linalg.norm(CENTRE_M)), ((height_m, rim_m),)
    alone = by_range(found, range_m, 0.06)
    assert (alone.edge, alone.rivals) == (0, ())
    unsure = by_range(found, range_m, 0.15, rim)
    assert {(0, unsure.circle), *unsure.rivals} == {(0, RING), (0, 0)}
    assert "circle of 0.615 m" in unsure.reason

    class Given(RingSensor):
        def read(self, sigma_m):
            prior = RingPrior(axis=axis, range_m=range_m, range_sigma_m=sigma_m)
            return self._read(0.0, Detection(found, 1.0, None), prior)

    opened = Given(CAMERA, RADIUS_M, circles=rim).read(0.15)
    assert opened.status is Status.AMBIGUOUS
    assert opened.measurement("ring") is None
    assert len(opened.record()["candidates"]) == 2
    sure = Given(CAMERA, RADIUS_M, circles=rim).read(0.03)
    assert sure.status is Status.OK
    assert np.linalg.norm(sure.circle.centre_m - CENTRE_M) < 0.002
    assert sure.circle.radius_m == RADIUS_M
    assert np.linalg.eigvalsh(sure.circle.covariance).min() > 0.0
