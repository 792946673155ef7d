"""Poses from photographs in the form of SPEED+ (Park et al. 2022), without and with a prior."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import nees
from rendezview.calibration.as_built import ShapeEstimator, strained
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel

RIGHT_DEG, WRONG_DEG, CLOSE_DEG = 5.0, 10.0, 2.0
PRIOR_DEG, PRIOR_SHARE = 5.0, 0.02  # errors of the priors
# Below these errors SPEED+ counts none: the accuracy of its own labels (Park et al. 2022).
FLOOR_DEG, FLOOR_SHARE = 0.169, 2.173e-3


def read(folder: Path) -> tuple[Camera, list[tuple[str, np.ndarray, Pose]]]:
    """The camera, and name, grey picture and camera_from_target of every photograph."""
    record = json.loads((folder / "camera.json").read_text())
    matrix = np.array(record["cameraMatrix"])
    camera = Camera(
        width=record["Nu"], height=record["Nv"], fx=matrix[0, 0], fy=matrix[1, 1],
        cx=matrix[0, 2], cy=matrix[1, 2], distortion=tuple(record["distCoeffs"]),
    )  # fmt: skip
    frames = []
    for label in json.loads((folder / "test.json").read_text()):
        picture = cv2.imread(str(folder / "images" / label["filename"]), cv2.IMREAD_GRAYSCALE)
        rotation = Rotation.from_quat(np.array(label["q_vbs2tango_true"])[[1, 2, 3, 0]])
        pose = Pose(rotation.as_matrix(), np.array(label["r_Vo2To_vbs_true"]))
        frames.append((label["filename"], picture, pose))
    return camera, frames


def near(pose: Pose, rng: np.random.Generator) -> Pose:
    """A pose off in a random direction: PRIOR_DEG, and PRIOR_SHARE of the distance."""
    turn, move = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    rotation = Rotation.from_rotvec(np.deg2rad(PRIOR_DEG) * turn).as_matrix() @ pose.rotation
    far = np.linalg.norm(pose.translation_m)
    return Pose(rotation, pose.translation_m + PRIOR_SHARE * far * move)


def look(recognizer: Recognizer, picture: np.ndarray, truth: Pose, prior: Pose | None) -> dict:
    """Errors of the pose of one photograph, given or not."""
    began_s = time.perf_counter()
    reach = None if prior is None else np.deg2rad(2.0 * PRIOR_DEG)
    seen = recognizer.recognize(picture, prior, reach)
    row: dict[str, Any] = {
        "given": seen.pose is not None, "status": str(seen.status), "confidence": seen.confidence,
        "time_s": time.perf_counter() - began_s, "nees": None,
    }  # fmt: skip
    pose = seen.pose or next(iter(seen.candidates), None)
    if pose is None:
        return row | {"rotation_deg": 180.0, "translation": 1.0}
    off = pose.translation_m - truth.translation_m
    turn = Rotation.from_matrix(pose.rotation @ truth.rotation.T).as_rotvec()
    row["rotation_deg"] = float(np.rad2deg(np.linalg.norm(turn)))
    row["translation"] = float(np.linalg.norm(off) / np.linalg.norm(truth.translation_m))
    if seen.covariance is not None:
        row["nees"] = nees(np.concatenate([turn, off]), seen.covariance)
    return row


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


def table(name: str, rows: list[dict]) -> None:
    """Shares and medians; frames without a pose count among all."""

    def column(key: str, of: list[dict] = rows) -> np.ndarray:
        return np.array([r[key] for r in of], dtype=np.float64)

    error, ok = column("rotation_deg"), column("given") > 0.0
    given = [r for r in rows if r["given"]]
    print(
        f"{name}: {len(rows)} frames, given {ok.mean():.0%}, "
        f"right (< {RIGHT_DEG:.0f}°) {(ok & (error < RIGHT_DEG)).mean():.0%}, "
        f"< {CLOSE_DEG:.0f}° {(ok & (error < CLOSE_DEG)).mean():.0%}, "
        f"wrong (> {WRONG_DEG:.0f}°) {(ok & (error > WRONG_DEG)).mean():.0%}"
    )
    if given:
        each = column("nees", [r for r in given if r["rotation_deg"] < RIGHT_DEG])
        print(
            f"    given: median {np.median(column('rotation_deg', given)):.2f}°, "
            f"{100 * np.median(column('translation', given)):.2f} %; NEES of the right ones, "
            f"median {np.nanmedian(each):.1f}, mean {np.nanmean(each):.1f}"
        )
    # Every frame answered by its best candidate, misses as 180° and the whole distance.
    turn, move, time_s = error, column("translation"), column("time_s")
    turn, move = np.where(turn < FLOOR_DEG, 0.0, turn), np.where(move < FLOOR_SHARE, 0.0, move)
    print(
        f"    every frame answered: {np.mean(turn):.1f}° mean ({np.mean(error < RIGHT_DEG):.0%} "
        f"< {RIGHT_DEG:.0f}°), SPEED+ score {np.mean(np.deg2rad(turn) + move):.3f}; "
        f"time {np.median(time_s):.2f} s median, {time_s.max():.2f} s worst"
    )


def run(
    model: Path, folder: Annotated[Path, "with camera.json, test.json and images"], *,
    no_sketch: Annotated[bool, "without the search on sketches"] = False,
    folds: Annotated[int, "calibrate the shape on the others; 0: as modelled"] = 0, seed: int = 1,
) -> None:  # fmt: skip
    """Poses from photographs in the form of SPEED+, without a prior and near three priors.

    A prior is 5° and 2 % of the distance off in a random direction.
    """
    cv2.setNumThreads(1)
    camera, frames = read(folder)
    models = calibrated(ViewModel.load(model), camera, [picture for _, picture, _ in frames], folds)
    recognizers = [Recognizer(one, camera, sketch=not no_sketch) for one in models]
    for recognizer in recognizers:
        recognizer.recognize(frames[0][1])  # compiles, and reads the network
    rng = np.random.default_rng(seed)
    alone: list[dict] = []
    near_priors: list[dict] = []
    for k, (name, picture, truth) in enumerate(frames):
        recognizer, starts = recognizers[k % len(recognizers)], [near(truth, rng) for _ in range(3)]
        first = look(recognizer, picture, truth, None)
        others = [look(recognizer, picture, truth, start) for start in starts]
        alone.append(first)
        near_priors += others
        close = " ".join(f"{r['rotation_deg']:.1f}°" for r in others)
        print(
            f"{name} {first['rotation_deg']:6.1f}° {100 * first['translation']:5.1f} % "
            f"{'given' if first['given'] else first['status']:>12} "
            f"{first['confidence'] or 0.0:.3f} {first['time_s']:.2f} s   prior {close}",
            flush=True,
        )
    table("no prior", alone)
    table("prior", near_priors)
