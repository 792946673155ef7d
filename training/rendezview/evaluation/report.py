"""The report of one run: pictures as PNG files, and one page that holds them all."""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rendezview.evaluation.evaluation import Evaluation
from rendezview.evaluation.page import Card, page
from rendezview.evaluation.palette import png
from rendezview.evaluation.report_frames import details, strip
from rendezview.evaluation.sphere_pictures import model_picture
from rendezview.evaluation.track_pictures import (
    error_curves,
    point_cloud,
    sighting_curves,
    stage_picture,
)
from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import StrPath, atomic_write, atomic_write_text, make_folder
from rendezview.io.sequences import Sequence
from rendezview.sensors.appearance import Sighting, ViewModel


def write_report(
    folder: StrPath,
    *,
    target_name: str,
    model: ViewModel,
    sequence: Sequence,
    sightings: Ordered[Sighting],
    evaluation: Evaluation | None = None,
    joined: bool = True,
) -> Path:
    """Write the PNG files and ``report.html``, which needs nothing but itself.

    Args:
        folder: made where missing; files of an earlier report are replaced.
        target_name: for the title.
        model: that recognised.
        sequence: the frames.
        sightings: one for each frame, in the same order.
        evaluation: of the results; None where the sequence has no truth.
        joined: the frames follow each other in time, so the track is a line.

    Returns:
        The path of ``report.html``.

    Raises:
        RendezviewError: a frame cannot be read, or a file not be written.
        ValueError: not one sighting for each frame, or no frames.
    """
    if len(sightings) != len(sequence) or not sightings:
        raise ValueError(f"{len(sightings)} sightings for {len(sequence)} frames")
    place = Path(folder)
    make_folder(place)
    results = {} if evaluation is None else {f.im_id: f for f in evaluation.frames}
    cards = [
        Card(f"frame_{sequence.frames[k].im_id:06d}", "frame", "", picture)
        for k, picture in strip(model, sequence, sightings, results, evaluation)
    ]
    cards += details(model, sequence, sightings, results)
    cards += _overview(model, sequence, sightings, evaluation, joined)
    for old in place.glob("frame_*.png"):
        old.unlink(missing_ok=True)
    for card in cards:
        with atomic_write(place / f"{card.name}.png", durable=False) as file:
            file.write(card.picture)
    path = place / "report.html"
    atomic_write_text(path, page(target_name, model, sequence, sightings, evaluation, cards))
    return path


def _overview(
    model: ViewModel,
    sequence: Sequence,
    sightings: Ordered[Sighting],
    evaluation: Evaluation | None,
    joined: bool,
) -> list[Card]:
    curves = _curves(model, sequence, sightings, evaluation)
    cloud = point_cloud(
        np.vstack([sighting.points_m for sighting in sightings]),
        centre_m=model.centre_m,
        target_radius_m=model.target_radius_m,
        estimates_m=_positions([s.pose for s in sightings]),
        truth_m=None
        if evaluation is None
        else _positions([frame.camera_from_target for frame in sequence]),
        joined=joined,
    )
    return [
        Card(
            "cloud",
            "Camera in the target's frame",
            "Every on node places the camera at its own direction and at the range that the "
            "silhouette's area gives.",
            png(cloud),
        ),
        Card("curves", "Frame by frame", "Curves break where there is no pose.", png(curves)),
        Card("stages", "Where the time goes", "", png(stage_picture(sightings))),
        Card("model", "The model", "Accuracy of every node's tree, and its size.",
             png(model_picture(model))),
    ]  # fmt: skip


def _curves(
    model: ViewModel,
    sequence: Sequence,
    sightings: Ordered[Sighting],
    evaluation: Evaluation | None,
) -> Figure:
    counts = {f.im_id: len(s.on_nodes) for f, s in zip(sequence, sightings, strict=True)}
    if evaluation is not None:
        return error_curves(evaluation, [counts[f.im_id] for f in evaluation.frames])
    ranges = [
        np.nan if s.pose is None else float(np.linalg.norm(s.pose.apply(model.centre_m)))
        for s in sightings
    ]
    times = [frame.time_s for frame in sequence if frame.time_s is not None]
    timed = len(times) == len(sequence)
    return sighting_curves(
        times if timed else [frame.im_id for frame in sequence],
        ranges,
        list(counts.values()),
        x_label="time, s" if timed else "frame",
    )


def _positions(poses: list[Pose | None]) -> Array:
    """(F, 3) camera positions in the target frame; NaN: no pose."""
    missing = np.full(3, np.nan)
    return np.array([missing if p is None else p.inverse().translation_m for p in poses])
