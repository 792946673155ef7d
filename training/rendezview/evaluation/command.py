"""``rendezview evaluate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from rendezview.camera import Camera
from rendezview.errors import RendezviewError
from rendezview.evaluation.evaluate import evaluate as evaluate_rows
from rendezview.results import read_results
from rendezview.sequences import open_sequence
from rendezview.training.bundled import find_target
from rendezview.training.mesh import load_mesh


def evaluate(
    scene: Annotated[Path, typer.Argument(help="BOP scene or SPEED folder with true poses.")],
    results: Annotated[Path, typer.Argument(help="Results, BOP CSV.")],
    target: Annotated[
        str | None,
        typer.Option(
            help="Target of the scene: its symmetries are honoured, and errors of direction, "
            "range and bearing are those of its middle instead of its origin."
        ),
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of a bare mesh.")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file, where the scene has none.")
    ] = None,
    wrong: Annotated[float, typer.Option(help="Degrees beyond which an answer is wrong.")] = 5.0,
    speed_plus: Annotated[
        bool, typer.Option("--speed-plus", help="SPEED score with the challenge's thresholds.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    obj_id: Annotated[
        int | None, typer.Option(help="Which object of a BOP scene is the target.")
    ] = None,
) -> None:
    """Compare results with the truth of their scene; every frame counts.

    Example: rendezview evaluate approach poses.csv --target hubble
    """
    if not 0.0 <= wrong <= 180.0:
        raise RendezviewError(f"--wrong must be an angle from 0 to 180 degrees, not {wrong}")
    sequence = open_sequence(scene, Camera.load(camera) if camera else None, obj_id=obj_id)
    found = find_target(target) if target else None
    centre_m = None
    if found is not None:
        centre_m, _ = load_mesh(found.mesh_path, unit or found.unit).bounding_sphere
    evaluation = evaluate_rows(
        sequence,
        read_results(results),
        found.symmetries if found else (),
        centre_m,
        wrong_rad=float(np.deg2rad(wrong)),
        speed_plus=speed_plus,
    )
    if as_json:
        typer.echo(json.dumps(evaluation.as_dict(), indent=2, allow_nan=False))
        return
    console = Console()
    console.print(evaluation.as_table())
    for note in evaluation.notes:
        console.print(note, highlight=False, soft_wrap=True)
