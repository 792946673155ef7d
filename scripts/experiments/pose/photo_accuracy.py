"""Poses from photographs in the form of SPEED+ (Park et al. 2022), without and with a prior."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from experiments.frame import nees, show, table_of, two
from experiments.peers import visp_edges
from rendezview import Camera, Pose, Recognizer, ViewModel, open_sequence
from rendezview.calibration.as_built import ShapeEstimator, strained
from rendezview.estimation.motion import extrapolate
from rendezview.geometry.symmetry import nearest_alike
from rendezview_ground.mesh.mesh import load_mesh

RIGHT_DEG, WRONG_DEG, CLOSE_DEG = 5.0, 10.0, 2.0
PRIOR_DEG, PRIOR_SHARE = 5.0, 0.02  # errors of the priors


def near(pose: Pose, rng: np.random.Generator) -> Pose:
    """A pose off in a random direction: PRIOR_DEG, and PRIOR_SHARE of the distance."""
    turn, move = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    far = np.linalg.norm(pose.translation_m)
    return extrapolate(pose, np.append(np.deg2rad(PRIOR_DEG) * turn, PRIOR_SHARE * far * move), 1.0)


def look(recognizer: Recognizer, picture: np.ndarray, truth: Pose, prior: Pose | None) -> dict:
    """Errors of the pose of one photograph, given or not."""
    began_s = time.perf_counter()
    reach = None if prior is None else np.deg2rad(2.0 * PRIOR_DEG)
    seen = recognizer.recognize(picture, prior, reach)
    row: dict[str, Any] = {
        "given": seen.pose is not None, "status": str(seen.status),
        "time_s": time.perf_counter() - began_s, "nees": None,
    }  # fmt: skip
    pose = seen.pose or next(iter(seen.candidates), None)
    if pose is not None:
        truth = nearest_alike(truth, pose, recognizer.model.symmetries)
    if pose is not None and seen.covariance is not None:
        row["nees"] = nees(pose.delta_from(truth), seen.covariance)
    return row | off(pose, truth)


def off(pose: Pose | None, truth: Pose) -> dict[str, float]:
    """Errors of a pose; of none, as large as can be."""
    if pose is None:
        return {"rotation_deg": 180.0, "translation": 1.0}
    error = pose.delta_from(truth)
    far = np.linalg.norm(truth.translation_m)
    return {
        "rotation_deg": float(np.rad2deg(np.linalg.norm(error[:3]))),
        "translation": float(np.linalg.norm(error[3:]) / far),
    }


def calibrated(
    model: ViewModel, camera: Camera, pictures: list[np.ndarray], folds: int
) -> list[ViewModel]:
    """For each fold of the photographs (k modulo the folds), the model with the shape that the
    other folds show; their poses are not known."""
    models = []
    for fold in range(folds):
        others = [picture for k, picture in enumerate(pictures) if k % folds != fold]
        found = ShapeEstimator(model, camera).estimate(others)
        sigma = np.round(100.0 * np.sqrt(np.diag(found.covariance)), 1)
        print(f"fold {fold}: strain {np.round(100.0 * found.components, 1)} %, σ {sigma} %, "
              f"from {found.used} of {len(others)} photographs", flush=True)  # fmt: skip
        models.append(strained(model, found.strain, found.covariance))
    return models or [model]


def row(name: str, rows: list[dict]) -> list[str]:
    """Shares, medians and times; frames without a pose count among all."""

    def column(key: str) -> np.ndarray:
        return np.array([r[key] for r in rows], dtype=np.float64)

    error, given, time_s = column("rotation_deg"), column("given") > 0.0, column("time_s")
    right = given & (error < RIGHT_DEG)
    kinds = (given, right, given & (error < CLOSE_DEG), given & (error > WRONG_DEG))
    median, normalised = "–", "–"
    if right.any():
        far = 100.0 * np.median(column("translation")[given])
        median, squares = f"{np.median(error[given]):.2f}°, {far:.2f} %", column("nees")[right]
        if np.isfinite(squares).any():
            normalised = f"{np.nanmedian(squares):.1f} / {np.nanmean(squares):.1f}"
    times = two(time_s, 100, "{:.2f} / {:.2f}") if np.isfinite(time_s).all() else "–"
    return [
        name, str(len(rows)), *(f"{share.mean():.0%}" for share in kinds), median, normalised,
        f"{error.mean():.1f}°", times,
    ]  # fmt: skip


def run(
    model: Path, folder: Annotated[Path, "with camera.json, test.json and images"], *,
    no_sketch: Annotated[bool, "without the search on sketches"] = False,
    folds: Annotated[int, "calibrate the shape on the others; 0: as modelled"] = 0, seed: int = 1,
    mesh: Annotated[Path | None, "in metres: ViSP's edge tracker beside it, same priors"] = None,
) -> None:  # fmt: skip
    """Poses from photographs in the form of SPEED+, without a prior and near three priors.

    A prior is 5° and 2 % of the distance off in a random direction. Poses that the target's
    symmetries make alike are one.
    """
    cv2.setNumThreads(1)
    sequence = open_sequence(folder)
    camera, pictures = sequence.frames[0].camera, [frame.read() for frame in sequence]
    models = calibrated(ViewModel.load(model), camera, pictures, folds)
    recognizers = [Recognizer(one, camera, sketch=not no_sketch) for one in models]
    for recognizer in recognizers:
        recognizer.recognize(pictures[0])  # compiles, and reads the network
    rng = np.random.default_rng(seed)
    alone: list[dict] = []
    near_priors: list[dict] = []
    asked: list[tuple[np.ndarray, Pose]] = []
    truths: list[Any] = []
    for k, (frame, picture) in enumerate(zip(sequence, pictures, strict=True)):
        truth = frame.camera_from_target
        recognizer, starts = recognizers[k % len(recognizers)], [near(truth, rng) for _ in range(3)]
        first = look(recognizer, picture, truth, None)
        others = [look(recognizer, picture, truth, start) for start in starts]
        alone.append(first)
        near_priors += others
        asked += [(picture, start) for start in starts]
        truths += [truth] * len(starts)
        errors = " ".join(f"{r['rotation_deg']:.1f}°" for r in (first, *others))
        print(f"{frame.name}: {first['status']}, {errors}", flush=True)
    columns = ("", "frames", "given", f"< {RIGHT_DEG:g}°", f"< {CLOSE_DEG:g}°", f"> {WRONG_DEG:g}°",
               "median of those given", "NEES of the right ones, median / mean",
               "mean of all, none: 180°", "s, median / worst")  # fmt: skip
    table = table_of("poses of photographs", columns)
    table.add_row(*row("no prior", alone))
    table.add_row(*row("prior", near_priors))
    if mesh:
        answers = visp_edges.poses(load_mesh(mesh, "m"), camera, asked)
        if answers is None:
            print("absent: ViSP: not installed")
        else:
            peer = [
                {"given": pose is not None, "time_s": None, "nees": None} | off(pose, truth)
                for pose, truth in zip(answers, truths, strict=True)
            ]
            table.add_row(*row("prior, ViSP's edges", peer))
    show(table, width=150)
