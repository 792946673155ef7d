"""``rendezview show``."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from matplotlib.figure import Figure
from rich.console import Console

from rendezview.cli.inputs import given_sequence
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.camera_files import load_camera
from rendezview.io.files import atomic_write, atomic_write_text, make_folder
from rendezview.io.results import read_json_lines, read_results
from rendezview.io.sequences import Frame, Sequence
from rendezview.io.sequences.frame import GreyImage
from rendezview.io.sequences.images import write_png
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.beacons.rig_files import load_rig
from rendezview_ground.evaluate.pictures.camera_pictures import camera_picture, rig_picture
from rendezview_ground.evaluate.pictures.log_pictures import (
    Track,
    measurement_picture,
    range_picture,
    ring_picture,
    track_of_records,
    track_picture,
)
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.pictures.sphere_pictures import model_picture
from rendezview_ground.evaluate.pictures.track_pictures import observation_curves, point_cloud
from rendezview_ground.evaluate.pictures.trajectory_pictures import path_picture, rate_picture
from rendezview_service.viewers.runs import moments

_CAMERA_SUFFIXES = (".json", ".yaml", ".yml", ".xml", ".txt", ".ini")
_PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".svg", ".pdf", ".webp")
_SCENE_FILES = ("scene_camera.json", "scene_gt.json")
_NODE_COLUMNS = (
    "node", "x", "y", "z", "depth", "leaves", "training_accuracy", "held_out_accuracy", "area_m2",
)  # fmt: skip
_SHEET = (4, 3)  # frames across and down
_CELL_PX = 320  # px; width of a frame on the sheet


def show(
    what: Annotated[
        Path,
        typer.Argument(
            help="Model (*.rvm), log (*.jsonl, *.mcap), results (*.csv), rig, camera or scene."
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder; default NAME-pictures.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera file, if the scene has none.")] = None,
) -> None:
    """Draw any file that rendezview writes.

    A model: the accuracy of its nodes over the sphere, and nodes.csv. A log of any sensor, of
    fuse or of the service: distance, attitude, σ and status of every frame; of track also active
    nodes, the point cloud, path and rates; of fuse also its measurements. Results: distance and
    attitude. A rig: its cameras in space. A camera file: what its lens does. A scene: a sheet of
    frames.

    \b
    Example: rendezview show hubble.rvm -o hubble-pictures
    """
    if not what.exists():
        raise RendezviewError(f"{what}: no such file or folder")
    if output is not None and output.suffix.lower() in _PICTURE_SUFFIXES and not output.is_dir():
        raise RendezviewError(
            f"-o {output}: pictures are written into a folder: name one, not a picture"
        )
    name = Path(what.name.removesuffix(".partial"))  # what was written before a run broke off
    folder = output or Path(f"{name.stem if what.is_file() else what.resolve().name}-pictures")
    suffix = name.suffix.lower() if what.is_file() else ""
    if suffix == ".rvm":
        written = _show_model(ViewModel.load(what), folder)
    elif suffix in (".jsonl", ".mcap"):
        written = _show_log(what, folder)
    elif suffix == ".csv":
        written = _show_results(what, folder)
    elif suffix in _CAMERA_SUFFIXES and what.name not in _SCENE_FILES:
        written = _show_calibration(what, folder)
    else:
        sequence = given_sequence(what, camera)
        written = [_show_scene(sequence, folder)]
    console = Console(stderr=True)
    for path in written:
        console.print(str(path), highlight=False, soft_wrap=True)


def _save(figure: Figure, path: Path) -> Path:
    make_folder(path.parent)
    with atomic_write(path, durable=False) as file:
        file.write(png(figure))
    return path


def _show_model(model: ViewModel, folder: Path) -> list[Path]:
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow(_NODE_COLUMNS)
    for k, direction in enumerate(model.geodesic.nodes):
        held_out = model.held_out_accuracy[k]
        writer.writerow(
            [
                k,
                *(f"{v:.6f}" for v in direction),
                model.forest.depth(k),
                model.forest.leaf_count(k),
                f"{model.training_accuracy[k]:.4f}",
                "" if np.isnan(held_out) else f"{held_out:.4f}",
                f"{model.views.area_m2[k]:.4f}",
            ]
        )
    make_folder(folder)
    atomic_write_text(folder / "nodes.csv", table.getvalue())
    return [_save(model_picture(model), folder / "model.png"), folder / "nodes.csv"]


def _show_log(path: Path, folder: Path) -> list[Path]:
    if path.suffix.lower() == ".mcap":
        records = [moment.record | {"time_s": moment.time_s} for moment in moments(path)]
    else:
        records = list(read_json_lines(path))
    if not records:
        raise RendezviewError(f"{path}: the log is empty")
    first = records[0]
    if "ellipses" in first:
        return [_save(ring_picture(records, str(path)), folder / "ring.png")]
    if "range_m" in first and "pose" not in first:
        return [_save(range_picture(records, str(path)), folder / "range.png")]
    track = track_of_records(records, str(path))
    written = [_save(track_picture(track, path.name), folder / "track.png")]
    if "on_nodes" in first and "points_m" in first:
        return written + _show_nodes(path, records, track, folder)
    measured = measurement_picture(records)
    return written + ([] if measured is None else [_save(measured, folder / "measurements.png")])


def _show_results(path: Path, folder: Path) -> list[Path]:
    rows = read_results(path)
    if not rows:
        raise RendezviewError(f"{path}: holds no poses")
    poses = [row.camera_from_target for row in rows]
    track = Track.of(
        [r.im_id for r in rows], "frame", poses, [None] * len(rows), ["ok"] * len(rows)
    )
    cloud = point_cloud(
        np.zeros((0, 3)), target_radius_m=0.1 * float(np.median(track.distance_m)),
        estimates_m=track.places_m,
    )  # fmt: skip
    return [
        _save(track_picture(track, path.name), folder / "track.png"),
        _save(cloud, folder / "cloud.png"),
    ]


def _show_calibration(path: Path, folder: Path) -> list[Path]:
    """A rig, or a single camera."""
    try:
        figure, name = rig_picture(load_rig(path)), "rig.png"
    except RendezviewError:
        figure, name = camera_picture(load_camera(path)), "camera.png"
    return [_save(figure, folder / name)]


def _show_nodes(
    path: Path, records: list[dict[str, Any]], track: Track, folder: Path
) -> list[Path]:
    """Active nodes, point cloud and path of a log of `rendezview track`."""
    try:
        points = [p for r in records for p in r["points_m"]]
        active_nodes = [len(r["on_nodes"]) for r in records]
        figures = {
            "curves.png": observation_curves(
                track.x, track.distance_m, active_nodes, x_label=track.x_label
            ),
            "cloud.png": point_cloud(
                np.reshape(points, (-1, 3)),
                target_radius_m=0.1 * float(np.nanmedian(track.distance_m)) if points else 1.0,
                estimates_m=track.places_m,
            ),
        }
        if all("trajectory" in r for r in records):
            figures["path.png"] = path_picture(records, _cloud_of_path(records))
            figures["rates.png"] = rate_picture(records, track.x, track.x_label)
    except (KeyError, TypeError, ValueError) as error:
        raise RendezviewError(f"{path}: not a log of `rendezview track` ({error})") from None
    return [_save(figure, folder / name) for name, figure in figures.items()]


def _cloud_of_path(records: list[dict[str, Any]]) -> Array:
    """(N, 3) points of the active nodes relative to the path's centre, in the plan's axes."""
    clouds = [np.array(r["points_m"]).reshape(-1, 3) - r["trajectory"]["centre_m"] for r in records]
    turns = [np.array(r["trajectory"]["path_from_target"]) for r in records]
    return np.concatenate([c @ t.T for c, t in zip(clouds, turns, strict=True)])


def _picture(frame: Frame) -> GreyImage:
    """The frame's image, or a black one labelled "unreadable"."""
    try:
        return frame.read()
    except RendezviewError:
        empty = np.zeros((frame.camera.height, frame.camera.width), dtype=np.uint8)
        scale = frame.camera.width / _CELL_PX
        place = (round(6 * scale), frame.camera.height // 2)
        cv2.putText(empty, "unreadable", place, 0, 0.7 * scale, 255, max(1, round(scale)))
        return empty


def _show_scene(sequence: Sequence, folder: Path) -> Path:
    """A sheet of frames, evenly spread over the sequence."""
    across, down = _SHEET
    chosen = np.unique(np.linspace(0, len(sequence) - 1, across * down).round().astype(int))
    cells = []
    for k in chosen:
        image = _picture(sequence.frames[k])
        height = round(_CELL_PX * image.shape[0] / image.shape[1])
        cell = cv2.resize(image, (_CELL_PX, height), interpolation=cv2.INTER_AREA)
        cv2.putText(cell, str(sequence.frames[k].im_id), (6, 18), 0, 0.5, 255, 1, cv2.LINE_AA)
        cells.append(cell)
    tallest = max(c.shape[0] for c in cells)
    sheet = np.zeros((tallest * -(-len(cells) // across), _CELL_PX * across), dtype=np.uint8)
    for k, cell in enumerate(cells):
        top, left = tallest * (k // across), _CELL_PX * (k % across)
        sheet[top : top + cell.shape[0], left : left + _CELL_PX] = cell
    make_folder(folder)
    path = folder / "frames.png"
    write_png(path, sheet)
    return path
