"""Evaluation of results against the truth of their sequence; every frame counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from collections.abc import Sequence as Rows

import numpy.typing as npt

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.results import ResultRow
from rendezview.io.sequences import Sequence
from rendezview_ground.evaluate.evaluation import WRONG_RAD, Evaluation, FrameResult
from rendezview_ground.evaluate.pose_errors import pose_errors
from rendezview_ground.evaluate.surface import ModelPoints, surface_errors


def evaluate(
    sequence: Sequence,
    rows: Iterable[ResultRow],
    symmetries: Rows[Symmetry] = (),
    centre_m: npt.ArrayLike | None = None,
    *,
    wrong_rad: float = WRONG_RAD,
    speed_plus: bool = False,
    surface: ModelPoints | None = None,
) -> Evaluation:
    """Compare results with the truth of a sequence.

    Every frame with truth counts; a frame without a row has no pose. Of several rows for one frame
    the one with the best score counts. Rows of other objects, and of frames without truth, are
    ignored. Notes report all of this.

    Args:
        sequence: with truth.
        rows: estimated poses, any order.
        symmetries: of the target.
        centre_m: (3,) view centre, target frame; None: the target's origin.
        wrong_rad: attitude error above which a pose is wrong.
        speed_plus: apply the thresholds of SPEED+ to each frame's SPEED score.
        surface: vertices of the target, for BOP's measures.

    Raises:
        RendezviewError: the sequence has no truth, a row belongs to none of its frames,
            or a true pose has no range.
    """
    known = {frame.im_id: frame for frame in sequence if frame.camera_from_target is not None}
    if not known:
        raise RendezviewError(
            f"{sequence.source}: no frame has a true pose: evaluate a sequence with truth"
        )
    all_ids = {frame.im_id for frame in sequence}
    best: dict[int, ResultRow] = {}
    left_out: Counter[str] = Counter()
    for row in rows:
        if row.scene_id != sequence.scene_id or row.im_id not in all_ids:
            raise RendezviewError(
                f"the results hold im_id {row.im_id} of scene {row.scene_id}, which is no frame of "
                f"{sequence.source} (scene {sequence.scene_id}): give the scene of these results"
            )
        if row.im_id not in known:
            left_out["of a frame without truth, left out"] += 1
        elif row.obj_id != known[row.im_id].obj_id:
            left_out["of another object, left out"] += 1
        elif row.im_id not in best:
            best[row.im_id] = row
        else:
            left_out["more than one for a frame, the best score counts"] += 1
            if row.score > best[row.im_id].score:
                best[row.im_id] = row
    results = []
    for im_id, frame in known.items():
        found, truth = best.get(im_id), frame.camera_from_target
        errors = surfaces = None
        if found is not None and truth is not None:
            with explained(
                f"{sequence.source}: im_id {im_id}: ", ": correct the truth or the target"
            ):
                errors = pose_errors(
                    truth,
                    found.camera_from_target,
                    symmetries=symmetries,
                    centre_m=centre_m,
                    speed_plus=speed_plus,
                )
            if surface is not None:
                estimate, camera = found.camera_from_target, frame.camera
                surfaces = surface_errors(truth, estimate, surface, camera.matrix, camera.width)
        score, computing_s = (None, None) if found is None else (found.score, found.time_s)
        results.append(
            FrameResult(im_id, frame.name, frame.time_s, errors, score, computing_s, surfaces)
        )
    notes = [f"{count} rows {what}" for what, count in sorted(left_out.items())]
    return Evaluation(tuple(results), tuple(notes), wrong_rad)
