"""``rendezview demo``: train, simulate, track, report."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from rendezview.cli.compiling import compile_ahead
from rendezview.cli.progress import ProgressBar
from rendezview.evaluation.evaluate import evaluate as evaluate_rows
from rendezview.evaluation.report import write_report
from rendezview.io.bundled import find_target
from rendezview.io.files import make_folder
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.appearance.following import follow, record, result_row
from rendezview.sensors.appearance.video import video_of
from rendezview.sensors.observation import Status
from rendezview.sensors.run import Line, run
from rendezview.simulation.command import default_camera
from rendezview.simulation.scene import SceneOptions, simulate
from rendezview.simulation.trajectories import TrajectoryOptions, trajectory
from rendezview.training.command import summary
from rendezview.training.command_options import Jobs
from rendezview.training.job import train
from rendezview.training.mesh import load_mesh
from rendezview.training.options import TrainingOptions

_VIEWS = 8_000  # perturbed views; fewer than the default, so that the demo is short
_HELD_OUT_VIEWS = 1000
_SHELLS = (1.0, 2.0)  # sphere radii; the ranges of the demo
_SUN_PHASE_DEG = 0.0  # degrees; the Sun is behind the camera, so there are no shadows


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the results.")] = Path(
        "rendezview-demo"
    ),
    frames: Annotated[int, typer.Option(min=1, help="Frames of the approach.")] = 60,
    jobs: Jobs = -1,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
) -> None:
    """Train, simulate, track and report, as a demonstration.

    The demo trains a model of a space telescope, simulates an approach from 61 m to 28 m half
    around it, finds the first pose among all attitudes, and tracks the others. A report has the
    trees' votes, errors and a video of the approach.

    Example: rendezview demo -o tour
    """
    console = Console(highlight=False, soft_wrap=True)
    start = time.perf_counter()
    target, camera = find_target("hubble"), default_camera()
    mesh = load_mesh(target.mesh_path, target.unit)
    make_folder(output)
    compile_ahead("train", "track")
    with ProgressBar() as progress:
        console.print(f"1. Training {target.name} on {len(mesh.faces)} triangles …")
        trained = train(
            mesh,
            output / "hubble.rvm",
            name=target.name,
            options=TrainingOptions(
                perturbed_views=_VIEWS,
                held_out_views=_HELD_OUT_VIEWS,
                contour_radii=_SHELLS,
                shadowed_silhouettes=False,  # the Sun is behind the camera
                seed=seed,
            ),
            camera=camera,
            jobs=jobs,
            progress=progress,
        )
        console.print(summary(trained), style="dim")
        model = trained.model
        console.print(f"2. Simulating an approach half around it: {frames} frames …")
        path = trajectory(
            "flyaround",
            TrajectoryOptions(
                frames=2 * frames - 1,
                start_range_m=2.4 * model.sphere_radius_m,
                end_range_m=1.1 * model.sphere_radius_m,
                centre_m=(
                    float(model.centre_m[0]),
                    float(model.centre_m[1]),
                    float(model.centre_m[2]),
                ),
                pointing_jitter_rad=float(np.deg2rad(0.4)),
                roll_jitter_rad=float(np.deg2rad(0.4)),
                seed=seed,
            ),
        )[:frames]  # the nearest frame is half-way around
        simulate(
            mesh,
            camera,
            path,
            SceneOptions(sun_phase_rad=float(np.deg2rad(_SUN_PHASE_DEG))),
            output / "scene",
            seed,
            jobs=jobs,
            progress=lambda done, total: progress("frames", done, total),
            overwrite=True,
        )
        console.print("3. Finding the first pose without a prior, and tracking …")
        sequence = open_sequence(output / "scene")
        observations: list[AppearanceObservation] = []

        def lines() -> Iterator[Line]:
            with video_of(output / "approach.mp4", sequence, model) as video:
                for frame, observation in follow(model, sequence, watch=video.watch):
                    observations.append(observation)
                    row = result_row(sequence.scene_id, frame, observation)
                    yield Line(record(frame, observation), observation.status, row)

        rows = run(
            lines(),
            log=output / "log.jsonl",
            results=output / "poses.csv",
            progress=progress.stage("tracking", len(sequence)),
        ).rows
    evaluation = evaluate_rows(sequence, rows, target.symmetries, model.centre_m)
    report = write_report(
        output,
        target_name=target.name,
        model=model,
        sequence=sequence,
        observations=observations,
        evaluation=evaluation,
    )
    console.print(evaluation.as_table())
    lost = sum(s.status is not Status.OK for s in observations)
    active = [len(s.active_nodes) for s in observations]
    console.print(
        f"{len(rows)} poses in {len(observations)} frames, {lost} without; "
        f"{np.mean(active):.1f} active nodes per frame; {time.perf_counter() - start:.0f} s in all"
    )
    console.print(f"Report: {report}, video: {output / 'approach.mp4'}")
    console.print(
        "The same run on the service's page, at http://127.0.0.1:8360/:\n"
        f"  rendezview serve {output / 'hubble.rvm'} --source {output / 'scene'}"
    )
