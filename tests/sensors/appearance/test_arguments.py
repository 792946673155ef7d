"""What a person writes against the library: conveniences work, wrong orders are named."""

from __future__ import annotations

import json
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview.sensors.observation import Observation, Status
from rendezview.sensors.ring import RingSensor
from rendezview.sensors.ring.observation import RingObservation


def frame_of(model, camera, bumpy_mesh, draw):
    rng = np.random.default_rng(8)
    truth = Pose(np.eye(3), [0.0, 0.0, 2.0 * model.sphere_radius_m])
    return draw(bumpy_mesh, truth, camera, rng), truth


def recognised(recognizer: Recognizer, image) -> str:
    return json.dumps(recognizer.recognize(image).as_dict() | {"stage_ms": {}})


def test_a_recognizer_is_sent_to_another_process(tiny_model, camera, bumpy_mesh, draw):
    image, _ = frame_of(tiny_model, camera, bumpy_mesh, draw)
    recognizer = Recognizer(tiny_model, camera, least_confidence=0.5, trees=False)
    again = pickle.loads(pickle.dumps(recognizer))
    assert (again.least_confidence, again.trees, again.camera) == (0.5, False, camera)
    expected = recognised(recognizer, image)
    assert recognised(again, image) == expected
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as others:
        assert others.submit(recognised, recognizer, image).result() == expected


def test_arguments_in_another_order_are_named(tiny_model, camera):
    image = np.zeros((camera.height, camera.width), np.uint8)
    recognizer = Recognizer(tiny_model, camera)
    wrong = [
        (lambda: Recognizer(camera, tiny_model), "Camera in place of ViewModel"),
        (lambda: Recognizer(tiny_model, camera.matrix), "ndarray in place of Camera"),
        (lambda: Recognizer("model.rvm", camera), "str in place of ViewModel"),
        (lambda: Tracker(tiny_model, camera), "ViewModel in place of Recognizer"),
        (lambda: Tracker(camera), r"Tracker\(Recognizer\(model, camera\)\)"),
        (lambda: Tracker(recognizer, prior=np.eye(4)), r"prior=Pose\.from_matrix"),
        (lambda: Tracker(recognizer).update(image, 0.0), r"update\(time_s, image\)"),
        (lambda: Tracker(recognizer).update(None, image), "NoneType in place of number"),
        (lambda: Tracker(recognizer).update("0", image), "str in place of number"),
        (lambda: Tracker(recognizer).update(0.0, None), "not None: was it read"),
        (lambda: recognizer.recognize(image, np.eye(4)), r"ndarray in place of Pose: .*matrix"),
        (lambda: recognizer.recognize(None), "not None"),
        (lambda: RingSensor(camera, 0.5).update(image, 0.0), r"update\(time_s, image\)"),
    ]
    for call, words in wrong:
        with pytest.raises(RendezviewError, match=words):
            call()


@pytest.mark.parametrize("error_rad", [0.0, -0.1, float("nan")])
def test_an_error_of_a_prior_that_is_not_positive_is_refused(tiny_model, camera, error_rad):
    """Zero was taken for the default of 20°; below, and of NaN, no pose was ever near enough."""
    image = np.zeros((camera.height, camera.width), np.uint8)
    prior = Pose(np.eye(3), [0.0, 0.0, 2.0 * tiny_model.sphere_radius_m])
    with pytest.raises(ValueError, match="prior_error_rad must be positive"):
        Recognizer(tiny_model, camera).recognize(image, prior, error_rad)


@pytest.mark.parametrize("since_s", [5e-324, 1e-310, 1e-12])
def test_frames_whose_rates_would_overflow_are_refused(
    tiny_model, camera, bumpy_mesh, draw, since_s
):
    image, truth = frame_of(tiny_model, camera, bumpy_mesh, draw)
    tracker = Tracker(Recognizer(tiny_model, camera), prior=truth)
    tracker.update(0.0, image)
    with pytest.raises(ValueError, match="order of time"):
        tracker.update(since_s, image)
    assert tracker.update(1e-9, image).time_s == 1e-9


def test_numbers_of_every_kind_are_times(tiny_model, camera):
    image = np.zeros((camera.height, camera.width), np.uint8)
    tracker = Tracker(Recognizer(tiny_model, camera))
    for time_s in (0, 1.5, np.float32(2.0), np.int64(3), np.float64(4.5)):
        assert tracker.update(time_s, image).status is Status.EMPTY
    with pytest.raises(ValueError, match="order of time"):
        tracker.update(float("nan"), image)


def test_a_frame_that_is_refused_leaves_its_time_and_what_is_expected_there(
    tiny_model, camera, bumpy_mesh, draw
):
    image, truth = frame_of(tiny_model, camera, bumpy_mesh, draw)
    tracker, other = (Tracker(Recognizer(tiny_model, camera)) for _ in range(2))
    for one in (tracker, other):
        one.expect(truth, np.eye(6) * 1e-4)
    with pytest.raises(RendezviewError, match="px"):
        tracker.update(1.0, image[1:])
    expected = other.update(1.0, image)
    assert tracker.update(1.0, image).as_dict() | {"stage_ms": {}} == (
        expected.as_dict() | {"stage_ms": {}}
    )
    with pytest.raises(ValueError, match="order of time"):
        tracker.update(1.0, image)
    with pytest.raises(RendezviewError, match="px"):
        tracker.update(1e6, image[1:])
    assert tracker.prior is not None  # a stamp far ahead has not aged it


def test_a_colour_frame_is_recognised_as_its_grey_one(tiny_model, camera, bumpy_mesh, draw):
    image, _ = frame_of(tiny_model, camera, bumpy_mesh, draw)
    recognizer = Recognizer(tiny_model, camera)
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    assert recognised(recognizer, colour) == recognised(recognizer, image)


def test_objects_show_themselves_in_a_line(tiny_model, camera):
    assert isinstance(tiny_model, ViewModel)
    assert repr(tiny_model).startswith("ViewModel('")
    assert len(repr(tiny_model)) < 100
    seen = Observation(
        Status.OK, time_s=2.0, pose=Pose(np.eye(3), [3.0, 0.0, 4.0]), confidence=0.98765
    )
    assert repr(seen) == "Observation('ok', time_s=2.0, range_m=5.0, confidence=0.9877)"
    ring = RingObservation(Status.NOT_FOUND, "no ellipse", time_s=1.0)
    assert repr(ring) == "RingObservation('not found', reason='no ellipse', time_s=1.0)"
    assert (
        len(
            repr(
                Recognizer(tiny_model, camera).recognize(
                    np.zeros((camera.height, camera.width), np.uint8)
                )
            )
        )
        < 200
    )


def test_an_observation_gives_its_range_and_its_values_for_json():
    seen = Observation(
        Status.OK, time_s=2.0, pose=Pose(np.eye(3), [3.0, 0.0, 4.0]), covariance=np.eye(6)
    )
    assert seen.range_m == 5.0
    assert Observation(Status.LOST, "gone").range_m is None
    values = seen.as_dict()
    assert json.loads(json.dumps(values)) == values
    assert values["pose"]["translation_m"] == [3.0, 0.0, 4.0]
