"""``rendezview train``."""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from rendezview.cli.compiling import compile_ahead
from rendezview.cli.inputs import given_camera, say_once
from rendezview.cli.progress import ProgressBar, as_json
from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview_ground.learn.command_options import Dask, Jobs
from rendezview_ground.learn.job import Trained
from rendezview_ground.learn.jobs.open_executor import open_executor
from rendezview_ground.learn.look_alike_words import look_alike_words
from rendezview_ground.learn.options import Neighbourhood, TrainingOptions
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.mesh.simplify import TOLERANCE_RADII
from rendezview_ground.mesh.symmetries import described
from rendezview_ground.render.renderers import Renderer, working_renderer

_DEFAULT = TrainingOptions()
_SHELLS = ",".join(f"{shell:g}" for shell in _DEFAULT.contour_radii)


def train(
    target: Annotated[
        str,
        typer.Argument(help="Mesh, target.toml or its folder, or hubble, client, scole, shuttle."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Model file to write (*.rvm).")],
    unit: Annotated[
        str | None, typer.Option(help="Unit of the mesh: m, cm, mm, in, ft; overrides the file.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Flight camera; sets sphere radius and sharpness.")
    ] = None,
    order: Annotated[int, typer.Option(help="Order of the sphere; 3 has 642 nodes.")] = 3,
    bins: Annotated[int, typer.Option(help="Readings of a signature.")] = 360,
    sphere_radius: Annotated[
        float | None, typer.Option(help="Radius of the sphere of views, metres.")
    ] = None,
    shells: Annotated[
        str, typer.Option(help="Distances of the contour points, sphere radii, for refinement.")
    ] = _SHELLS,
    resolution: Annotated[int, typer.Option(help="Pixels of a clean view.")] = 512,
    views: Annotated[
        int, typer.Option(help="Perturbed views for training.")
    ] = _DEFAULT.perturbed_views,
    held_out: Annotated[
        int, typer.Option(help="Perturbed views for the reported accuracy.")
    ] = _DEFAULT.held_out_views,
    paper: Annotated[
        bool, typer.Option("--paper", help="As in the paper: 73 clean views per node, raw bins.")
    ] = False,
    neighbourhood: Annotated[
        Neighbourhood, typer.Option(help="Interpretation of the paper's 73 views.")
    ] = Neighbourhood.DISC,
    renderer: Annotated[Renderer, typer.Option(help="Renderer of the views.")] = Renderer.NUMBA,
    joint_step: Annotated[
        float,
        typer.Option(
            min=1.0, max=90.0, help="Degrees between the configurations of a target with joints."
        ),
    ] = 15.0,
    jobs: Jobs = -1,
    dask: Dask = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random views.")] = 0,
) -> None:
    """Train a view model of a target.

    Repeat the command to continue a killed job where it stopped.

    \b
    Example: rendezview train mysat.stl --unit mm --camera camera.yaml -o mysat.rvm
    """
    console = Console(stderr=True)
    found = find_target(target)
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    flight_camera = given_camera(camera)
    if as_json():
        say_once(*mesh.doubts)
    notes = "\n".join(mesh.notes)
    if console.is_terminal:  # in a log they come at the end, so that an error is one line
        console.print(notes, highlight=False, style="dim", soft_wrap=True)
    options = TrainingOptions(
        order=order,
        bins=bins,
        sphere_radius_m=sphere_radius,
        contour_radii=_radii(shells),
        resolution_px=resolution,
        perturbed_views=views,
        held_out_views=held_out,
        neighbourhood=neighbourhood,
        renderer=renderer,
        seed=seed,
    )
    if dask is None:  # a cluster has its own OpenGL
        tell = functools.partial(console.print, highlight=False, markup=False, soft_wrap=True)
        options = replace(options, renderer=working_renderer(options.renderer, mesh, tell))
    if paper:
        options = replace(options.paper(), held_out_views=held_out)
    start = time.perf_counter()
    if dask is None:
        compile_ahead("train")
    with (
        open_executor(jobs, dask, tell=lambda line: console.print(line, style="dim")) as executor,
        ProgressBar() as progress,
    ):
        trained = train_target(
            found,
            mesh,
            output,
            unit,
            options=options,
            camera=flight_camera,
            step_rad=float(np.deg2rad(joint_step)),
            executor=executor,
            progress=progress,
        )
    if not console.is_terminal:
        console.print(notes, highlight=False, soft_wrap=True)
    console.print(
        f"{summary(trained)}\n{output}: {output.stat().st_size / 1e6:.1f} MB in "
        f"{time.perf_counter() - start:.0f} s",
        highlight=False,
        soft_wrap=True,
    )


def _radii(text: str) -> tuple[float, ...]:
    try:
        return tuple(sorted({float(part) for part in text.split(",")}))
    except ValueError:
        raise RendezviewError(
            f"--shells must be numbers such as 0.5,1,1.5,3, not {text!r}"
        ) from None


def summary(trained: Trained) -> str:
    """Summary of a training, in a few lines."""
    model, forest = trained.model, trained.model.forest
    depths = [forest.depth(k) for k in range(len(forest))]
    leaves = [forest.leaf_count(k) for k in range(len(forest))]
    features = [forest.feature_count(k) for k in range(len(forest))]
    lines = [
        f"{model.name}: sphere of {model.sphere_radius_m:.2f} m around a target of "
        f"{model.target_radius_m:.2f} m, {len(forest)} nodes, {len(model.lattice.nodes)} views",
        f"trees: depth {np.mean(depths):.1f} (at most {max(depths)}), "
        f"{np.mean(leaves):.0f} leaves, {np.median(features):.0f} features (at most "
        f"{max(features)}); "
        f"{100 * np.mean(model.training_accuracy):.1f} % of the training samples correct",
    ]
    given, drawn = model.provenance["triangles"], trained.drawn_triangles
    if drawn is not None and drawn < given:
        moved_mm = 1000.0 * TOLERANCE_RADII * model.target_radius_m
        lines.append(
            f"views drawn with {drawn} of {given} triangles: no surface moved by more than "
            f"{moved_mm:.2g} mm"
        )
    if model.contours is not None:
        lit = 0 if model.lit is None else len(model.lit.sun)
        lines.append(
            f"refinement: {model.contours.kind.shape[2]} contour points per view from "
            f"{len(model.contours.shells_m)} distances, {lit} shadowed silhouettes"
        )
    if model.symmetries or not model.joints:  # with joints they are not searched
        lines.append(f"the target {described(model.symmetries)}")
    shape = model.shape
    words = shape and look_alike_words(shape.turns, shape.alike, model.symmetries)
    if words:
        lines.append(f"{words}: a first pose is given only where the frame tells them apart")
    for k, joint in enumerate(model.joints):
        angles = sorted(
            {float(np.rad2deg(m.angles_rad[k])) for m in (model, *model.configurations)}
        )
        lines.append(
            f"joint {joint.name!r}: {len(angles)} angles from {angles[0]:.1f}° to {angles[-1]:.1f}°"
        )
    if trained.decisions is not None:
        d = trained.decisions
        right = d.in_right.sum() + d.out_right.sum()
        total = d.in_total.sum() + d.out_total.sum()
        lines.append(
            f"held-out decisions correct: {100 * right / max(total, 1):.1f} %, "
            f"in-views {100 * d.in_right.sum() / max(d.in_total.sum(), 1):.1f} %, "
            f"out-views {100 * d.out_right.sum() / max(d.out_total.sum(), 1):.1f} %; "
            f"direction of view to {np.rad2deg(model.held_out.direction_rad):.1f}° per axis, "
            f"range to {100 * model.held_out.range_fraction:.1f} %"
        )
    return "\n".join(lines)
