"""Whether the voters' view of a first pose adds to the confidence that the edges give."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from experiments.frame import Log, mesh_of, show, table_of, write_log
from experiments.recognition.ablation import CAMERA, RIGHT_DEG, frame_of
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance import Recognizer, ViewModel

SILENT = -2.2  # log odds of voters that know nothing
MOST = 3.0  # of the votes' deviation from that
WEIGHTS = (0.0, 0.1, 0.2, 0.3, 0.5, 0.8)
GIVEN = 0.6  # least confidence of a pose that is given
LOW_SUN_DEG = 25.0  # of frames below, one in three is taken: they are hardly ever wrong

Record = dict[str, Any]


def looked(recognizer: Recognizer, seed: int, k: int, mesh: Any) -> Record | None:
    """The best pose of a frame: its confidence by the edges, its votes, and its error."""
    model = recognizer.model
    frame, truth, _, phase = frame_of(mesh, model, 90.0, [seed, k])
    if phase < np.deg2rad(LOW_SUN_DEG) and k % 3:
        return None
    found = recognizer.recognize(frame).found
    if found is None or found.votes is None:
        return None
    off = float(np.rad2deg(angle_between(found.best.pose, truth, model.symmetries)))
    return {"seed": seed, "off": off, "confidence": found.confidence, "votes": found.votes}


def judged(odds: Array, wrong: Array, given: int) -> list[str]:
    """Log loss, and wrong poses among so many of the highest odds."""
    loss = np.mean(np.log1p(np.exp(np.where(wrong, odds, -odds))))
    first = np.argsort(-odds, kind="stable")[:given]
    return [f"{loss:.4f}", str(int(wrong[first].sum()))]


def run(
    model: Annotated[str, "model file"],
    target: Annotated[str, "mesh, target.toml, or hubble, client, scole"],
    *, frames: int = 1000, seeds: tuple[int, int] = (4301, 4303), log: Log = None,
) -> None:  # fmt: skip
    """Whether the voters' view of a first pose adds to the confidence that the edges give.

    FRAMES of each seed as in tree-ablation, Sun 0–90°; of those below 25° one in three is taken.
    The log odds of a pose are those of the edges plus a weight times its votes less −2.2, cut at
    ±3. For each weight: the mean log loss, and the wrong poses among as many of the highest odds
    as the edges alone give. Choose a weight on one seed, judge it on the other.
    """
    name, mesh = mesh_of(target)
    recognizer = Recognizer(ViewModel.load(model), CAMERA, sketch=False)
    records = [
        found
        for seed in range(*seeds)
        for k in range(frames)
        if (found := looked(recognizer, seed, k, mesh)) is not None
    ]
    write_log(log, records)
    rows = table_of(name, "seed | frames | given | weight | log loss | wrong at the same share")
    for seed in range(*seeds):
        some = [r for r in records if r["seed"] == seed]
        confidence = np.clip([r["confidence"] for r in some], 1e-9, 1.0 - 1e-9)
        edges = np.log(confidence / (1.0 - confidence))
        votes = np.clip(np.array([r["votes"] for r in some]) - SILENT, -MOST, MOST)
        wrong = np.array([r["off"] for r in some]) >= RIGHT_DEG
        given = int(np.sum(confidence >= GIVEN))
        for weight in WEIGHTS:
            cells = judged(edges + weight * votes, wrong, given)
            rows.add_row(str(seed), str(len(some)), str(given), f"{weight:g}", *cells)
    show(rows)
