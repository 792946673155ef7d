"""The report of one run: pictures as PNG files, and one page with all of them."""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import StrPath, atomic_write, atomic_write_text, make_folder
from rendezview.io.sequences import Sequence
from rendezview.sensors.appearance import AppearanceObservation, ViewModel
from rendezview_ground.evaluate.evaluation import Evaluation
from rendezview_ground.evaluate.page import PNG, Card, page
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.pictures.sphere_pictures import model_picture
from rendezview_ground.evaluate.pictures.track_pictures import (
    error_curves,
    frame_axis,
    observation_curves,
    point_cloud,
    stage_picture,
)
from rendezview_ground.evaluate.report_frames import details, frame_row


def write_report(
    folder: StrPath,
    *,
    target_name: str,
    model: ViewModel,
    sequence: Sequence,
    observations: Ordered[AppearanceObservation],
    evaluation: Evaluation | None = None,
    joined: bool = True,
    more: Ordered[Card] = (),
) -> Path:
    """Write the PNG files and ``report.html``, which contains all pictures.

    Args:
        folder: created if missing; files of an earlier report are replaced.
        target_name: for the title.
        model: of the target.
        sequence: the frames.
        observations: one for each frame, in the same order.
        evaluation: of the results; None without truth.
        joined: the frames are a sequence, so the track is a line.
        more: pictures and videos of one's own. Pictures become PNG files, too.

    Returns:
        The path of ``report.html``.

    Raises:
        RendezviewError: a frame cannot be read, or a file not be written.
        ValueError: not one observation per frame, or no frames.
    """
    if len(observations) != len(sequence) or not observations:
        raise ValueError(f"{len(observations)} observations for {len(sequence)} frames")
    place = Path(folder)
    make_folder(place)
    results = {} if evaluation is None else {f.im_id: f for f in evaluation.frames}
    cards = [
        Card(f"frame_{sequence.frames[k].im_id:06d}", "frame", "", picture)
        for k, picture in frame_row(model, sequence, observations, results, evaluation)
    ]
    cards += details(model, sequence, observations, results)
    cards += [*_overview(model, sequence, observations, evaluation, joined), *more]
    for old in place.glob("frame_*.png"):
        old.unlink(missing_ok=True)
    for card in (card for card in cards if card.kind == PNG):
        with atomic_write(place / f"{card.name}.png", durable=False) as file:
            file.write(card.picture)
    path = place / "report.html"
    atomic_write_text(path, page(target_name, model, sequence, observations, evaluation, cards))
    return path


def _overview(
    model: ViewModel,
    sequence: Sequence,
    observations: Ordered[AppearanceObservation],
    evaluation: Evaluation | None,
    joined: bool,
) -> list[Card]:
    curves = _curves(model, sequence, observations, evaluation)
    cloud = point_cloud(
        np.vstack([observation.points_m for observation in observations]),
        centre_m=model.centre_m,
        target_radius_m=model.target_radius_m,
        estimates_m=_positions([s.pose for s in observations]),
        truth_m=None
        if evaluation is None
        else _positions([frame.camera_from_target for frame in sequence]),
        joined=joined,
    )
    return [
        Card(
            "cloud",
            "Camera in the target's frame",
            "Every active node places the camera in its own direction, at the range that the "
            "silhouette's area gives.",
            png(cloud),
        ),
        Card("curves", "Frame by frame", "Gaps are frames without a pose.", png(curves)),
        Card("stages", "Computing time", "Of each stage; of whole frames it is in the table.",
             png(stage_picture(observations))),
        Card("model", "The model", "Accuracy and size of every node's tree.",
             png(model_picture(model))),
    ]  # fmt: skip


def _curves(
    model: ViewModel,
    sequence: Sequence,
    observations: Ordered[AppearanceObservation],
    evaluation: Evaluation | None,
) -> Figure:
    counts = {f.im_id: len(s.active_nodes) for f, s in zip(sequence, observations, strict=True)}
    if evaluation is not None:
        return error_curves(evaluation, [counts[f.im_id] for f in evaluation.frames])
    ranges = [
        np.nan if s.pose is None else float(np.linalg.norm(s.pose.apply(model.centre_m)))
        for s in observations
    ]
    x, x_label = frame_axis(sequence)
    return observation_curves(x, ranges, list(counts.values()), x_label=x_label)


def _positions(poses: list[Pose | None]) -> Array:
    """(F, 3) camera positions in the target frame; NaN: no pose."""
    missing = np.full(3, np.nan)
    return np.array([missing if p is None else p.inverse().translation_m for p in poses])
