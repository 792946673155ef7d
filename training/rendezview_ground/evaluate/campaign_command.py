"""``rendezview campaign``."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from rendezview.cli.inputs import given_camera, say_once
from rendezview.cli.progress import ProgressBar
from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.evaluate.campaign import Answers, CampaignOptions
from rendezview_ground.evaluate.campaign import campaign as run_campaign
from rendezview_ground.learn.command_options import Dask, Jobs
from rendezview_ground.learn.jobs.open_executor import open_executor
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.simulate.command import default_camera

_DEFAULT = CampaignOptions()


def campaign(
    model: Annotated[Path, typer.Argument(help="Model file (*.rvm).")],
    target: Annotated[str, typer.Argument(help="Its target: mesh, target.toml, or bundled name.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Results to write, JSON lines.")],
    unit: Annotated[str | None, typer.Option(help="Unit of a bare mesh.")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera of the frames; default 640 × 480, 53° across.")
    ] = None,
    frames: Annotated[
        int, typer.Option(help="Frames; each is recognised twice.")
    ] = _DEFAULT.frames,
    sun_phase: Annotated[
        tuple[float, float], typer.Option(help="Angle Sun, target, camera, degrees: from, to.")
    ] = (0.0, 30.0),
    ranges: Annotated[
        tuple[float, float],
        typer.Option(help="Ranges: from, to; 1 is where the target fills the picture."),
    ] = _DEFAULT.range_radii,
    seed: Annotated[int, typer.Option(min=0, help="Of poses, light and noise.")] = 0,
    jobs: Jobs = -1,
    dask: Dask = None,
) -> None:
    """Measure a model on random simulated frames, with and without a prior.

    Example: rendezview campaign hubble.rvm hubble -o answers.jsonl --frames 2000
    """
    console = Console(stderr=True)
    options = CampaignOptions(
        frames=frames,
        sun_phase_rad=(math.radians(sun_phase[0]), math.radians(sun_phase[1])),
        range_radii=ranges,
        seed=seed,
    )
    views = ViewModel.load(model)
    found = find_target(target)
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    say_once(*mesh.doubts)
    if abs(mesh.bounding_sphere[1] / views.target_radius_m - 1.0) > 0.1:
        raise RendezviewError(
            f"the target of {model} has a radius of {views.target_radius_m:.3g} m, {target} has "
            f"{mesh.bounding_sphere[1]:.3g} m: give the mesh it was trained on, and its unit"
        )
    start = time.perf_counter()
    with (
        open_executor(
            jobs, dask, processes=True, tell=lambda line: console.print(line, style="dim")
        ) as executor,
        ProgressBar() as progress,
    ):
        answers = run_campaign(
            views,
            mesh,
            given_camera(camera) or default_camera(),
            output,
            executor,
            options,
            progress,
        )
    table = Table(title=f"{views.name}: {frames} random frames, seed {seed}")
    for head in (
        "look", "right %", "wrong %", "rotation ° median / 95 %", "translation % of range",
        "NEES mean / median",
    ):  # fmt: skip
        table.add_column(head, justify="right")
    for look, answer in answers.items():
        table.add_row(look, *_row(answer))
    Console(width=110).print(table)
    console.print(f"{output}: in {time.perf_counter() - start:.0f} s", highlight=False)


def _row(answer: Answers) -> list[str]:
    right = answer.right
    shares = [
        f"{100 * np.mean(right):.1f}",
        f"{100 * np.mean(answer.given & ~right):.1f}",
    ]
    if not right.any():
        return [*shares, "–", "–", "–"]
    rotation = np.rad2deg(answer.rotation_rad[right])
    return [
        *shares,
        f"{np.median(rotation):.3f} / {np.percentile(rotation, 95):.2f}",
        f"{100 * np.median(answer.translation[right]):.3f}",
        f"{np.mean(answer.nees[right]):.1f} / {np.median(answer.nees[right]):.1f}",
    ]
