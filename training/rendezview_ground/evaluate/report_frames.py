"""Single frames of the report: a row of frames, and one frame in detail."""

from __future__ import annotations

from collections.abc import Sequence as Ordered

import numpy as np
from matplotlib.figure import Figure

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.io.sequences import Sequence
from rendezview.sensors.appearance import AppearanceObservation, ViewModel
from rendezview.sensors.appearance.model.signature import rolled, twist
from rendezview_ground.evaluate.evaluation import Evaluation, FrameResult
from rendezview_ground.evaluate.page import Card
from rendezview_ground.evaluate.pictures.frame_pictures import frame_overlay
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.pictures.signature_pictures import signature_picture, tree_tests
from rendezview_ground.evaluate.pictures.sphere_pictures import sphere_picture

_SHOWN = 8  # frames
_SHOWN_PROBLEMS = 3  # of them without a pose or with a wrong one


def shown_frames(count: int, missing: set[int], wrong: set[int]) -> list[int]:
    """Positions of eight evenly spread frames. Three or more are problems.

    Args:
        count: of all frames.
        missing: positions of frames without a pose.
        wrong: positions of frames with a wrong pose; some of both kinds are shown.
    """
    good = [k for k in range(count) if k not in missing | wrong]
    room = max(_SHOWN_PROBLEMS, _SHOWN - len(good))
    some = _spread(sorted(wrong), max(room // 2, room - len(missing)))
    some += _spread(sorted(missing), room - len(some))
    return sorted(some + _spread(good, _SHOWN - len(some)))


def _spread(items: list[int], most: int) -> list[int]:
    if len(items) <= most:
        return items
    return [items[int(k)] for k in np.linspace(0, len(items) - 1, most).round()]


def frame_row(
    model: ViewModel,
    sequence: Sequence,
    observations: Ordered[AppearanceObservation],
    results: dict[int, FrameResult],
    evaluation: Evaluation | None,
) -> list[tuple[int, bytes]]:
    """Position and picture (PNG) of each frame in the row."""
    wrong_ids = set() if evaluation is None else set(evaluation.wrong)
    missing = {k for k, observation in enumerate(observations) if observation.pose is None}
    wrong = {k for k, f in enumerate(sequence) if f.im_id in wrong_ids} - missing
    pictures = []
    for k in shown_frames(len(sequence), missing, wrong):
        frame, observation = sequence.frames[k], observations[k]
        title = f"#{frame.im_id}" + ("" if frame.time_s is None else f"   {frame.time_s:.1f} s")
        note, image = "", None
        errors = results[frame.im_id].errors if frame.im_id in results else None
        if errors is not None and observation.pose is not None:
            note = (
                f"{'Wrong: e' if k in wrong else 'E'}rror "
                f"{np.rad2deg(errors.rotation_rad):.1f}° in attitude, "
                f"{100.0 * errors.range_fraction:.1f} % in range"
            )
        try:
            image = frame.read()
        except RendezviewError:
            if observation.pose is not None:
                raise
        figure = frame_overlay(
            image, observation, frame.camera, model, title=title, note=note, bad=k in wrong
        )
        pictures.append((k, png(figure)))
    return pictures


def details(
    model: ViewModel,
    sequence: Sequence,
    observations: Ordered[AppearanceObservation],
    results: dict[int, FrameResult],
) -> list[Card]:
    """Sphere and signature of one typical frame."""
    chosen = _typical(sequence, observations, results)
    if chosen is None:
        return []
    frame, observation = sequence.frames[chosen], observations[chosen]
    assert observation.pose is not None
    cards = [
        Card(
            "sphere",
            f"Sphere of views, frame #{frame.im_id}",
            "Each cell is a node with its own decision tree. Outlined cells are active: their "
            "trees recognise this view. The sphere is seen from the estimated camera position.",
            png(
                sphere_picture(
                    model,
                    active_nodes=observation.active_nodes,
                    direction=_direction(model, observation.pose),
                    truth=None
                    if frame.camera_from_target is None
                    else _direction(model, frame.camera_from_target),
                )
            ),
        )
    ]
    figure = _signature(model, observation)
    if figure is not None:
        cards.append(
            Card(
                "signature",
                f"Signature, frame #{frame.im_id}",
                "Distance from the silhouette's centroid to its outermost edge, rolled to the "
                "best active node. Short bars are the thresholds that its tree tested.",
                png(figure),
            )
        )
    return cards


def _typical(
    sequence: Sequence,
    observations: Ordered[AppearanceObservation],
    results: dict[int, FrameResult],
) -> int | None:
    """Position of the recognised frame with the median error, or else the median score."""
    ranked = []
    for k, (frame, observation) in enumerate(zip(sequence, observations, strict=True)):
        if observation.pose is not None:
            errors = results[frame.im_id].errors if frame.im_id in results else None
            ranked.append((observation.score if errors is None else errors.rotation_rad, k))
    return sorted(ranked)[len(ranked) // 2][1] if ranked else None


def _direction(model: ViewModel, camera_from_target: Pose) -> Array:
    """(3,) from the view centre to the camera, target frame."""
    return np.asarray(camera_from_target.inverse().translation_m - model.centre_m)


def _signature(model: ViewModel, observation: AppearanceObservation) -> Figure | None:
    if (
        observation.signature is None
        or observation.pose is None
        or not len(observation.active_nodes)
    ):
        return None
    node = int(observation.active_nodes[int(np.argmax(observation.weights))])
    attitude = observation.signature.centred_from_camera @ observation.pose.rotation
    roll = float(twist(attitude, model.views.centred_from_target[node]))
    readings = rolled(observation.signature.readings, roll)
    tests = tree_tests(model.forest, node, readings)
    return signature_picture(readings, model.views.readings[node], tests, node=node)
