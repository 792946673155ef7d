"""Poses over fields of view and picture sizes, and the worst time of any picture and option."""

from __future__ import annotations

import time
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from rendezview.evaluation.campaign import second_earlier
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.training.mesh import Mesh
from scipy.spatial.transform import Rotation

from experiments.frame import Log, mesh_of, show, table_of, write_log
from experiments.pose.accuracy import Record, both_looks, row
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import load_camera
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.outline.bright_sky import find_bodies
from rendezview.sensors.appearance.outline.foreground import Foreground
from rendezview.sensors.appearance.outline.silhouette import (
    Cleaning,
    SilhouetteOptions,
    Threshold,
    find_silhouette,
)

FIELDS_DEG = [5.0, 10.0, 30.0, 60.0, 90.0]
SIZES = ["640x480", "1920x1200", "5120x3840"]
RADIUS = (0.2, 0.42)  # of the picture's height: the target's sphere
LEVELS_GREY = (2.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 60.0, 100.0, 200.0)


def drawn(
    mesh: Mesh, model: ViewModel, camera: Camera, rng: np.random.Generator
) -> tuple[np.ndarray, Pose, float]:
    """A frame of any attitude with the Sun 0–60° from behind, its pose, and the radius in px."""
    radius_px = rng.uniform(*RADIUS) * camera.height
    depth_m = camera.fx * model.target_radius_m / radius_px
    depth_m = max(depth_m, 1.4 * model.target_radius_m)  # before the camera, at wide fields
    room = np.array([camera.width, camera.height]) / 2.0 - 1.1 * radius_px
    shift = rng.uniform(-1.0, 1.0, 2) * np.maximum(room, 0.0) / camera.fx
    centre = np.array([*shift, 1.0]) * depth_m
    rotation = Rotation.random(random_state=rng).as_matrix()
    pose = Pose(rotation, centre - rotation @ model.centre_m)
    sun = sun_at_phase(centre, np.deg2rad(rng.uniform(0.0, 60.0)), rng.uniform(0.0, 6.28))
    return render_frame(mesh, camera, pose, sun, SceneOptions(), rng, 0.0), pose, radius_px


def looks(
    target: str, models: Path, field_deg: float, size: str, count: int, seed: int
) -> list[Record]:
    """Both looks at every frame of one field and size."""
    _, mesh = mesh_of(target)
    model = ViewModel.load(models / f"{Path(target).stem}.rvm")
    width, height = map(int, size.split("x"))
    camera = Camera.from_fov(width, height, np.deg2rad(field_deg))
    recognizer = Recognizer(model, camera)
    records = []
    for k in range(count):
        rng = np.random.default_rng([seed, width, round(field_deg), k])
        image, truth, radius_px = drawn(mesh, model, camera, rng)
        prior = second_earlier(truth, model.centre_m, rng)
        about = {"target": model.name, "field": field_deg, "size": size, "radius_px": radius_px}
        records += [about | look for look in both_looks(recognizer, image, truth, prior)]
    return records


def run(
    models: Path, targets: list[str], *, fields: list[float] = FIELDS_DEG,
    sizes: list[str] = SIZES, count: Annotated[int, "frames of each cell and target"] = 10,
    seed: int = 1, log: Log = None,
) -> None:  # fmt: skip
    """First poses and tracked poses over fields of view (degrees) and picture sizes.

    MODELS is a folder with a model <target>.rvm of each target. Frames of our own simulator: any
    attitude, Sun 0–60° from behind the camera, the radius of the target's sphere 20 to 42 % of the
    picture's height, anywhere in the picture but whole. Each is read as in pose-accuracy.
    """
    records: list[Record] = []
    columns = (
        "mode, field, size", "n", "right %", "best right %", "wrong %", "rotation ° median / 95 %",
        "translation % of range", "NEES mean / median", "ms",
    )  # fmt: skip
    rows = table_of(f"poses by field and size, seed {seed}", columns, left=0)
    for field_deg, size in product(fields, sizes):
        cell = [r for t in targets for r in looks(t, models, field_deg, size, count, seed)]
        records += cell
        for mode in ("first", "tracked"):
            part = [r for r in cell if r["mode"] == mode]
            rows.add_row(*row(f"{mode} {field_deg:g}° {size}", part))
            print(*row(f"{mode} {field_deg:g}° {size}", part), sep=" | ", flush=True)
    write_log(log, records)
    show(rows, width=170)


def times(
    pictures: Path, *, model: Annotated[Path | None, "a model: whole first poses too"] = None,
    camera: Annotated[Path | None, "its camera file"] = None,
) -> None:  # fmt: skip
    """The worst time of any picture of a folder under any option, on one core.

    The silhouette under every kind of threshold and cleaning, averaged over 1, 3 and 15 px, at 12
    fixed levels, and before a bright sky; with a model and a camera, a first pose under every kind
    of threshold.
    """
    cv2.setNumThreads(1)
    images = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in sorted(pictures.iterdir())]
    frames = [np.asarray(image) for image in images if image is not None]
    kinds: list[dict[str, Any]] = [{}, {"threshold": Threshold.OTSU}]
    kinds += [{"threshold": Threshold.FIXED, "level_grey": grey} for grey in LEVELS_GREY]
    spent: dict[str, list[float]] = {}

    def clock(name: str, call: object, *arguments: object) -> None:
        start = time.process_time()
        call(*arguments)  # type: ignore[operator]
        spent.setdefault(name, []).append(time.process_time() - start)

    network = Foreground()
    find_silhouette(frames[0]), find_bodies(frames[0], network)  # compiled and read
    for frame in frames:
        clock("silhouette, bright sky", find_bodies, frame, network)
        for kind, cleaning, averaged in product(kinds, Cleaning, (1, 3, 15)):
            options = SilhouetteOptions(
                rival_fraction=2.0, merge_gap=0.6, cleaning=cleaning, averaged_px=averaged, **kind
            )
            clock(f"silhouette, {options.threshold}", find_silhouette, frame, options)
    if model is not None and camera is not None:
        views, lens = ViewModel.load(model), load_camera(camera)
        for kind in (None, *kinds[1:]):
            silhouette = kind and SilhouetteOptions(rival_fraction=2.0, merge_gap=0.6, **kind)
            recognizer = Recognizer(views, lens, silhouette)
            recognizer.recognize(frames[0])
            for frame in frames:
                name = Threshold.NOISE if silhouette is None else silhouette.threshold
                clock(f"first pose, {name}", recognizer.recognize, frame)
    rows = table_of(f"{len(frames)} pictures", ("what", "median s", "worst s"))
    for name, each in spent.items():
        rows.add_row(name, f"{np.median(each):.3f}", f"{max(each):.3f}")
    show(rows)
