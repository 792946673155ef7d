"""Threads that share a recognizer or a tracker get the answers of serial calls, byte for byte."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.sensors.threads import THREADS, assert_shared, together

from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, Tracker
from rendezview.sensors.observation import Status

FRAMES = 12


def answer(observation: AppearanceObservation) -> tuple[Any, ...]:
    """All that an observation says but its times, in bytes."""
    pose, covariance = observation.pose, observation.covariance
    points_m, trust = observation.cloud
    return (
        str(observation.status),
        observation.reason,
        None if pose is None else pose.rotation.tobytes() + pose.translation_m.tobytes(),
        None if covariance is None else covariance.tobytes(),
        observation.confidence,
        observation.active_nodes.tobytes(),
        observation.weights.tobytes(),
        observation.points_m.tobytes(),
        points_m.tobytes() + trust.tobytes(),
    )


@pytest.fixture(scope="module")
def looks(refining_model, bumpy_mesh, camera, draw) -> list[tuple[np.ndarray, Pose]]:
    """Frames of a turning target, and a prior for each."""
    rng = np.random.default_rng(20)
    start = Rotation.from_rotvec([0.4, 1.0, 0.2])
    looks = []
    for k in range(FRAMES):
        rotation = (Rotation.from_rotvec(0.04 * k * np.array([1.0, -0.7, 0.5])) * start).as_matrix()
        centre = np.array([0.3 - 0.05 * k, 0.02 * k, 9.0 + 0.1 * k])
        pose = Pose(rotation, centre - rotation @ refining_model.centre_m)
        prior = pose.perturbed([*rng.normal(0.0, 0.05, 3), 0.0, 0.0, 0.1])
        looks.append((draw(bumpy_mesh, pose, camera, rng), prior))
    return looks


@pytest.mark.parametrize("with_prior", [True, False])
def test_threads_on_one_recognizer_get_serial_answers(refining_model, camera, looks, with_prior):
    recognizer = Recognizer(refining_model, camera)

    def look(k: int) -> tuple[Any, ...]:
        image, prior = looks[k % FRAMES]
        return answer(recognizer.recognize(image, prior if with_prior else None))

    serial = assert_shared(look, list(range(FRAMES)))
    assert any(status == "ok" for status, *_ in serial)


def test_threads_that_ask_for_clouds_get_serial_ones(tiny_model, camera, bumpy_mesh, draw):
    rng = np.random.default_rng(21)
    recognizer = Recognizer(tiny_model, camera)
    observations = []
    for _ in range(6):
        rotation = Rotation.random(random_state=rng).as_matrix()
        centre = np.array([0.0, 0.0, 2.0 * tiny_model.sphere_radius_m])
        pose = Pose(rotation, centre - rotation @ tiny_model.centre_m)
        observations.append(recognizer.recognize(draw(bumpy_mesh, pose, camera, rng), pose))
    clouds = together(lambda k: observations[k % 6].cloud, range(24))
    for k, (points_m, trust) in enumerate(clouds):
        serial_m, serial_trust = observations[k % 6].cloud
        assert points_m.tobytes() + trust.tobytes() == serial_m.tobytes() + serial_trust.tobytes()


def test_threads_on_one_tracker_get_the_answers_of_a_serial_run(refining_model, camera, looks):
    """Of frames that come too late none counts; the others are answered as in a serial run."""
    tracker = Tracker(Recognizer(refining_model, camera), looks[0][1])

    def look(k: int) -> tuple[Any, ...] | None:
        try:
            return answer(tracker.update(float(k), looks[k][0]))
        except ValueError:  # another thread was faster with a later frame
            return None

    found = together(look, range(FRAMES))
    accepted = [k for k in range(FRAMES) if found[k] is not None]
    serial = Tracker(Recognizer(refining_model, camera), looks[0][1])
    expected = [answer(serial.update(float(k), looks[k][0])) for k in accepted]
    assert FRAMES - 1 in accepted
    assert [found[k] for k in accepted] == expected


def test_a_tracker_looks_at_one_frame_at_a_time():
    class Slow:
        """A recognizer that notes how many threads are inside it."""

        def __init__(self) -> None:
            self.prior_error_rad = 0.3
            self.model = SimpleNamespace(centre_m=np.zeros(3), target_radius_m=1.0)
            self.search = None
            self.overflows = lambda pose: False
            self.inside = self.most = 0
            self.priors: list[Pose | None] = []

        def overflows(self, pose: Pose) -> bool:
            return False

        def recognize(
            self, image, prior, *_: Any, time_s: float, **_more: Any
        ) -> AppearanceObservation:
            self.inside += 1
            self.most = max(self.most, self.inside)
            self.priors.append(prior)
            time.sleep(0.05)
            self.inside -= 1
            pose = Pose(np.eye(3), [0.0, 0.0, 5.0 + time_s])
            return AppearanceObservation(Status.OK, pose=pose, time_s=time_s)

    recognizer = Slow()
    tracker = Tracker(recognizer)

    def look(k: int) -> float | None:
        time.sleep(0.01 * k)  # while the frames before are being looked at
        try:
            return tracker.update(float(k), np.zeros((4, 4), np.uint8)).time_s
        except ValueError:
            return None

    accepted = [time_s for time_s in together(look, range(THREADS)) if time_s is not None]
    assert recognizer.most == 1
    assert recognizer.priors[0] is None
    assert all(prior is not None for prior in recognizer.priors[1:])
    assert tracker.prior.translation_m[2] == 5.0 + max(accepted)
