"""``rendezview assess``."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer
from rich.console import Console
from rich.table import Table

from rendezview.cli.inputs import given_camera, say_once
from rendezview.cli.progress import ProgressBar
from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.files import atomic_write, check_place
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.surface import ALBEDO_UNIT
from rendezview_ground.evaluate.assessment import WRONG_RAD, Answers, AssessmentOptions, Conditions
from rendezview_ground.evaluate.assessment import assess as run_assessment
from rendezview_ground.evaluate.pictures.assessment_picture import assessment_picture
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.learn.command_options import Dask, Jobs
from rendezview_ground.learn.jobs.open_executor import open_executor
from rendezview_ground.mesh.mesh import Mesh, load_mesh
from rendezview_ground.simulate.command import default_camera

_KNOWN = {
    "first": "nothing else",
    "tracked": "a pose to 5°",
    "sun": "the Sun's direction",
    "second": "a frame from 5° beside",
}
_SIDES = ("+X", "−X", "+Y", "−Y", "+Z", "−Z")
_BINS = 3  # of range and Sun phase
_HEADS = (
    "right %", "wrong %", "ambiguous %", "attitude ° median / 95 %", "its σ °", "range %",
    "NEES mean",
)  # fmt: skip


def assess(
    model: Annotated[Path, typer.Argument(help="Model file (*.rvm).")],
    target: Annotated[
        str | None,
        typer.Argument(
            help="Its target: mesh, target.toml, or bundled name. Default: the light mesh that "
            "the model carries."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output",
            help="Answers to write, JSON lines; a picture beside it. Default: MODEL.assess.jsonl.",
        ),
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of a bare mesh.")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera of the frames; default 640 × 480, 53° across.")
    ] = None,
    frames: Annotated[int, typer.Option(help="Frames; each is recognised in four ways.")] = 300,
    sun_phase: Annotated[
        tuple[float, float], typer.Option(help="Angle Sun, target, camera, degrees: from, to.")
    ] = (0.0, 75.0),
    ranges: Annotated[
        tuple[float, float],
        typer.Option(help="Ranges: from, to; 1 is where the target fills the picture."),
    ] = (1.0, 3.0),
    earth: Annotated[float, typer.Option(help="Share of frames before the Earth.")] = 0.25,
    seed: Annotated[int, typer.Option(min=0, help="Of poses, light and noise.")] = 0,
    jobs: Jobs = -1,
    dask: Dask = None,
) -> None:  # fmt: skip
    """Say how accurate a model is on its craft: by view, range, Sun and background.

    Frames are simulated. Each is recognised on its own, near a prior pose, with the Sun's
    direction, and after a frame from 5° beside: what each would gain.

    Example: rendezview assess hubble.rvm hubble
    """
    console = Console(stderr=True)
    options = AssessmentOptions(
        frames=frames,
        sun_phase_rad=(math.radians(sun_phase[0]), math.radians(sun_phase[1])),
        range_radii=ranges,
        earth=earth,
        seed=seed,
    )
    path = output or model.with_suffix(".assess.jsonl")
    check_place(path.with_suffix(".png"), "the picture")
    views = ViewModel.load(model)
    mesh = _carried(views, model) if target is None else _mesh(views, model, target, unit)
    start = time.perf_counter()
    with (
        open_executor(
            jobs, dask, processes=True, tell=lambda line: console.print(line, style="dim")
        ) as executor,
        ProgressBar() as progress,
    ):
        seen, answers = run_assessment(
            views, mesh, given_camera(camera) or default_camera(), path, executor, options, progress
        )
    printed = Console(width=118)
    printed.print(_by_knowledge(f"{views.name}: {frames} random frames, seed {seed}", answers))
    printed.print(_by_condition(seen, answers["first"]))
    with atomic_write(path.with_suffix(".png")) as file:
        file.write(png(assessment_picture(seen, answers["first"])))
    seconds = time.perf_counter() - start
    console.print(
        f"wrong: more than {math.degrees(WRONG_RAD):g}° off. {path} and "
        f"{path.with_suffix('.png').name}, in {seconds:.0f} s", highlight=False,
    )  # fmt: skip


def _carried(views: ViewModel, model: Path) -> Mesh:
    if views.shape is None:
        raise RendezviewError(f"{model}: it carries no mesh; name its target, too")
    grey = (views.shape.albedo * ALBEDO_UNIT).astype(np.float32)
    vertices = views.shape.vertices_m + views.centre_m
    return Mesh(vertices, views.shape.faces, np.repeat(grey[:, None], 3, axis=1), ())


def _mesh(views: ViewModel, model: Path, target: str, unit: str | None) -> Mesh:
    found = find_target(target)
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    say_once(*mesh.doubts)
    if abs(mesh.bounding_sphere[1] / views.target_radius_m - 1.0) > 0.1:
        raise RendezviewError(
            f"the target of {model} has a radius of {views.target_radius_m:.3g} m, {target} has "
            f"{mesh.bounding_sphere[1]:.3g} m: give the mesh it was trained on, and its unit"
        )
    return mesh


def _table(title: str, *first: str) -> Table:
    table = Table(title=title)
    for k, head in enumerate((*first, *_HEADS)):
        table.add_column(head, justify="right" if k else "left")
    return table


def _by_knowledge(title: str, answers: dict[str, Answers]) -> Table:
    table = _table(title, "known beside the frame")
    for look, answer in answers.items():
        table.add_row(_KNOWN[look], *_row(answer, np.ones(len(answer.status), dtype=bool)))
    return table


def _by_condition(seen: Conditions, answer: Answers) -> Table:
    """Answers of nothing but the frame, by what it shows."""
    table = _table("with the frame alone", "frames", "number")

    def add(name: str, chosen: npt.NDArray[np.bool_]) -> None:
        if chosen.any():
            table.add_row(name, str(chosen.sum()), *_row(answer, chosen))

    main = np.argmax(np.abs(seen.direction), axis=1)
    for k, side in enumerate(_SIDES):
        add(f"seen from {side}", (main == k // 2) & ((seen.direction[:, k // 2] < 0.0) == k % 2))
    table.add_section()
    phase_deg = np.rad2deg(seen.sun_phase_rad)
    for values, form in ((seen.range_m, "{:.3g}–{:.3g} m"), (phase_deg, "Sun at {:.0f}–{:.0f}°")):
        edges = np.linspace(values.min(), values.max(), _BINS + 1)
        place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, _BINS - 1)
        for k in range(_BINS):
            add(form.format(edges[k], edges[k + 1]), place == k)
        table.add_section()
    add("black sky", ~seen.earth)
    add("before the Earth", seen.earth)
    return table


def _row(answer: Answers, chosen: npt.NDArray[np.bool_]) -> list[str]:
    right = answer.right & chosen
    shares = [
        f"{100 * np.mean(each[chosen]):.1f}"
        for each in (answer.right, answer.given & ~answer.right, answer.ambiguous)
    ]
    if not right.any():
        return [*shares, "–", "–", "–", "–"]
    rotation = np.rad2deg(answer.rotation_rad[right])
    return [
        *shares,
        f"{np.median(rotation):.3f} / {np.percentile(rotation, 95):.2f}",
        f"{np.rad2deg(np.median(answer.sigma_rad[right])):.3f}",
        f"{100 * np.median(answer.translation[right]):.3f}",
        f"{np.mean(answer.nees[right]):.1f}",
    ]
