"""``rendezview evaluate``."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from rendezview.cli.inputs import given_sequence
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.bundled import find_target
from rendezview.io.files import atomic_write, make_folder
from rendezview.io.results import read_results
from rendezview_ground.evaluate.bop_models import bop_model
from rendezview_ground.evaluate.comparison import (
    comparison_dict,
    comparison_table,
    score_table,
)
from rendezview_ground.evaluate.evaluate import evaluate as evaluate_rows
from rendezview_ground.evaluate.evaluation import Evaluation
from rendezview_ground.evaluate.nees import nees_text, normalised_errors
from rendezview_ground.evaluate.pictures.error_pictures import share_picture
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.pictures.stanford_pictures import stanford_picture
from rendezview_ground.evaluate.pictures.track_pictures import error_curves
from rendezview_ground.evaluate.scores import scores
from rendezview_ground.evaluate.stanford import Judged, judged_log, stanford_dict, stanford_text
from rendezview_ground.evaluate.surface import ModelPoints, alike_of
from rendezview_ground.evaluate.tum import results_of_tum
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.mesh.symmetries import described, find_symmetries

_TUM = (".tum", ".txt")  # of trajectories


def evaluate(
    scene: Annotated[Path, typer.Argument(help="BOP scene or SPEED folder with true poses.")],
    results: Annotated[
        list[Path],
        typer.Argument(
            help="Results, BOP CSV or TUM (.tum, .txt); several are compared side by side."
        ),
    ],
    target: Annotated[
        str | None,
        typer.Option(
            help="Target of the scene: its symmetries are respected, errors of direction, range, "
            "bearing refer to its centre instead of its origin, and BOP's surface measures are "
            "added. For BOP models (obj_000001.ply), models_info.json is read."
        ),
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of a bare mesh.")] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera file, if the scene has none.")] = None,
    wrong: Annotated[
        float, typer.Option(help="Attitude error, degrees, above which a pose is wrong.")
    ] = 5.0,
    speed_plus: Annotated[
        bool,
        typer.Option(
            "--speed-plus", help="Apply the thresholds of SPEED+ to each frame's SPEED score."
        ),
    ] = False,
    log: Annotated[
        Path | None,
        typer.Option(
            help="Log of track: errors against covariances (NEES) of the right poses, and against "
            "protection levels."
        ),
    ] = None,
    plots: Annotated[Path | None, typer.Option(help="Folder for pictures of the errors.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    obj_id: Annotated[
        int | None, typer.Option(help="Which object of a BOP scene is the target.")
    ] = None,
) -> None:
    """Compare results with the truth of their scene; every frame counts.

    Example: rendezview evaluate approach ours.csv theirs.csv --target hubble
    """
    if not 0.0 <= wrong <= 180.0:
        raise RendezviewError(f"--wrong must be an angle from 0 to 180 degrees, not {wrong}")
    sequence = given_sequence(scene, camera, obj_id)
    reference = _reference(target, unit)
    evaluations: dict[str, Evaluation] = {}
    for path in results:
        name = path.stem if len({p.stem for p in results}) == len(results) else str(path)
        if name in evaluations:
            raise RendezviewError(f"{path}: is given twice: name each results file once")
        evaluations[name] = evaluate_rows(
            sequence,
            results_of_tum(path, sequence) if path.suffix in _TUM else read_results(path),
            reference.symmetries,
            reference.centre_m,
            wrong_rad=float(np.deg2rad(wrong)),
            speed_plus=speed_plus,
            surface=reference.surface,
        )
    nees = None if log is None else normalised_errors(sequence, log, reference.symmetries)
    levels = None if log is None else judged_log(sequence, log, reference.symmetries)
    if plots is not None:
        _draw(evaluations, levels, plots)
    single = next(iter(evaluations.values())) if len(evaluations) == 1 else None
    if as_json:
        if single is None:
            content = comparison_dict(evaluations)
        else:
            content = {**single.as_dict(), "scores": asdict(scores(single))}
        if nees is not None:
            content["nees"] = nees.tolist()
        if levels is not None:
            content["protection"] = stanford_dict(levels)
        typer.echo(json.dumps(content, indent=2, allow_nan=False))
        return
    console = Console()
    if single is None:
        console.print(comparison_table(evaluations))
    else:
        console.print(single.as_table())
        console.print(score_table(single))
    if nees is not None:
        console.print(nees_text(nees), highlight=False, soft_wrap=True)
    if levels is not None:
        console.print(stanford_text(levels), highlight=False, soft_wrap=True)
    for name, part in evaluations.items():
        notes = (
            part.notes if single is None else ()
        )  # the table of a single result contains its notes
        for note in notes:
            console.print(f"{name}: {note}", highlight=False, soft_wrap=True)
    for note in reference.notes:
        console.print(note, highlight=False, soft_wrap=True)


def _draw(evaluations: dict[str, Evaluation], levels: Judged | None, folder: Path) -> None:
    """Shares of frames below each error, errors over the frames, errors against their levels."""
    make_folder(folder)
    figures = {"share.png": share_picture(evaluations)}
    if levels is not None:
        figures["stanford.png"] = stanford_picture(levels, "Errors against protection levels")
    for name, part in evaluations.items():
        figures[f"errors-{Path(name).stem}.png"] = error_curves(part)
    for name, figure in figures.items():
        with atomic_write(folder / name, durable=False) as file:
            file.write(png(figure))
        Console(stderr=True).print(str(folder / name), highlight=False, soft_wrap=True)


@dataclass(frozen=True, slots=True, eq=False)
class _Reference:
    """The target's geometry, for the evaluation."""

    symmetries: tuple[Symmetry, ...] = ()
    centre_m: Array | None = None
    surface: ModelPoints | None = None
    notes: tuple[str, ...] = ()


def _reference(target: str | None, unit: str | None) -> _Reference:
    if target is None:
        return _Reference()
    found = find_target(target)
    model, notes = bop_model(found.mesh_path), tuple[str, ...]()
    mesh = load_mesh(found.mesh_path, unit or found.unit or ("mm" if model else None))
    centre_m, _ = mesh.bounding_sphere
    points_m = mesh.vertices_m[np.unique(mesh.faces)]
    if model is None:
        alike = found.symmetries
        if not (alike or found.joints):  # as training does
            alike = find_symmetries(mesh)
        if alike:
            notes = (f"the target {described(alike)}: the nearest of its equivalent poses counts",)
        surface = ModelPoints.of(points_m, alike_of(alike))
        return _Reference(alike, centre_m, surface, notes)
    surface = ModelPoints.of(points_m, model.alike, model.diameter_m)
    if model.unused:
        notes = (
            f"{model.unused} symmetries of the model are none beside the others (no common point "
            "of the axes, or turns that never come round): they count in MSSD and MSPD only",
        )
    return _Reference(model.symmetries, centre_m, surface, notes)
