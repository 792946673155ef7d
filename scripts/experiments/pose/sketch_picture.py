"""The picture of docs/photographs.md: frames in hard light, their sketches, the poses found."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from rendezview.sensors.appearance.sketch.network import COVER, CREASE, EDGE, Sketch
from rendezview.training.mesh import load_mesh

from experiments.frame import PICTURES
from experiments.pose.sketch_confidence import frame
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.sky import Sky

SIDE = 300  # px of a picture
ROWS = 3
TRIED = 60  # frames, of which the first with a confident pose are shown
LIFT = 0.6  # exponent: dark parts become visible
COLOURS = {EDGE: (90, 190, 255), CREASE: (200, 130, 50)}  # blue, green, red


def scaled(picture: np.ndarray) -> np.ndarray:
    grey = np.clip(255.0 * (picture / 255.0) ** LIFT, 0, 255).astype(np.uint8)
    grey = np.asarray(cv2.resize(grey, (SIDE, SIDE), interpolation=cv2.INTER_AREA))
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))


def drawn(sketch: Sketch, camera: Camera) -> np.ndarray:
    zoom = SIDE / camera.width
    warp = np.array(
        [[1.0, 0.0, -sketch.left_px], [0.0, 1.0, -sketch.top_px]]
    ) * (zoom / sketch.scale)  # fmt: skip
    maps = [cv2.warpAffine(m, warp, (SIDE, SIDE)) for m in sketch.maps]
    picture = 60.0 * maps[COVER][..., None] * np.ones(3)
    for k, colour in COLOURS.items():
        picture = picture + maps[k][..., None] * np.array(colour)
    return np.clip(picture, 0, 255).astype(np.uint8)


def with_pose(picture: np.ndarray, model: ViewModel, camera: Camera, pose: Pose) -> np.ndarray:
    axes = camera.project(pose.apply(model.centre_m + 0.6 * model.target_radius_m * np.eye(3)))
    centre = camera.project(pose.apply(model.centre_m))
    zoom = SIDE / camera.width
    for end, colour in zip(axes, ((60, 60, 255), (60, 220, 60), (255, 120, 60)), strict=True):
        a, b = (tuple(int(v) for v in np.rint(zoom * (p + 0.5) - 0.5)) for p in (centre, end))
        cv2.line(picture, a, b, colour, 2, cv2.LINE_AA)
    return picture


def run(
    model: Path,
    mesh: Path,
    *,
    seed: int = 902,
    output: Annotated[Path, "picture"] = PICTURES / "sketch.png",
) -> None:
    """Draw the first frames of a seed that get a confident pose, and print its errors."""
    views, shape = ViewModel.load(model), load_mesh(mesh, "m")
    rows = []
    for k in range(TRIED):
        picture, camera, truth = frame(shape, np.random.default_rng([seed, k]))
        search = Recognizer(views, camera).sketch
        choice = None if search is None else search.anywhere(picture, Sky.of(picture))
        if search is None or choice is None or choice.confidence < 0.6:
            continue
        sketch = search.sketcher.find(picture)
        if sketch is None:
            continue
        error_deg = np.rad2deg(choice.best.pose.angle_to(truth))
        print(f"frame {k}: {error_deg:.2f}°, confidence {choice.confidence:.2f}")
        found = with_pose(scaled(picture), views, camera, choice.best.pose)
        rows.append(np.hstack([scaled(picture), drawn(sketch, camera), found]))
        if len(rows) == ROWS:
            break
    cv2.imwrite(str(output), np.vstack(rows))
