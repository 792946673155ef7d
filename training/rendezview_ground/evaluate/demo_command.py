"""``rendezview demo``: train, simulate, track, fuse, report."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from rich.console import Console

from rendezview.cli.compiling import compile_ahead, compile_beside
from rendezview.cli.main import GROUP
from rendezview.cli.progress import ProgressBar
from rendezview.geometry import so3
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.file_lock import FolderLock
from rendezview.io.files import make_folder
from rendezview.io.sequences import Sequence, open_sequence
from rendezview.io.target import DockingRing
from rendezview.sensors.appearance import AppearanceObservation, ViewModel
from rendezview.sensors.appearance.following import follow, record, result_row
from rendezview.sensors.appearance.video import video_of
from rendezview.sensors.run import Line, Summary, run
from rendezview_ground.evaluate.evaluate import evaluate as evaluate_rows
from rendezview_ground.evaluate.page import WEBM, Card
from rendezview_ground.evaluate.pictures.contact import contact_picture, fuse_to_contact
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.report import write_report
from rendezview_ground.learn.command import summary
from rendezview_ground.learn.command_options import Jobs
from rendezview_ground.learn.job import train
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.simulate.command import default_camera
from rendezview_ground.simulate.ranger import Ranger, write_echoes
from rendezview_ground.simulate.scene import SceneOptions, simulate
from rendezview_ground.simulate.trajectories import (
    TimedPose,
    TrajectoryOptions,
    trajectory,
    triple,
)

_TARGET = "client"  # it has a docking ring
_ORDER = 2  # 162 nodes instead of 642: as many poses, as accurate, in half the time
_VIEWS = 8_000  # perturbed views; fewer than the default, so that the demo is short
_HELD_OUT_VIEWS = 1000
_SHELLS = (1.0, 2.0)  # sphere radii; the ranges of the demo
_SUN_PHASE_DEG = 0.0  # degrees; the Sun is behind the camera, so there are no shadows
_AROUND = 2.0 / 3.0  # share of the frames that fly around the target; the others end at the ring
_RANGES = (2.4, 1.1)  # sphere radii; first and last range of the fly-around
_LAST_M = 2.0  # m; a ring of 1.2 m still fits the picture. Source: its half angle, 17° of 20°
# degrees, one σ of each axis of the camera: around the target, and on the last metres, where the
# filter predicts from frame to frame
_JITTER_DEG = (0.4, 0.05)
_STEP_S = 4.0  # s between frames; the craft closes in at 0.3 m/s
_RANGER = Ranger(origin_m=(0.1, 0.0, 0.0), sigma_m=0.01)


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the results.")] = Path(
        "rendezview-demo"
    ),
    frames: Annotated[int, typer.Option(min=6, help="Frames of the approach.")] = 60,
    jobs: Jobs = -1,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
) -> None:
    """Train, simulate, track, fuse and report, as a demonstration.

    The demo trains a model of a satellite, simulates a flight half around it and on to 2 m before
    its docking ring, finds the first pose among all attitudes, and tracks the others. On the last
    metres, camera, ring and laser ranger are fused. A report has videos, the trees' votes and the
    errors of all sensors.

    Example: rendezview demo -o tour
    """
    console = Console(highlight=False, soft_wrap=True)
    start = time.perf_counter()
    target, camera = find_target(_TARGET), default_camera()
    ring = target.docking_ring
    assert ring is not None
    mesh = load_mesh(target.mesh_path, target.unit)
    make_folder(output)
    model_path = output / f"{target.name}.rvm"
    compile_ahead("train")
    with (
        FolderLock(output),
        compile_beside("track", "hard", "demo") as compiled,
        ProgressBar() as progress,
    ):
        console.print(f"1. Training {target.name} on {len(mesh.faces)} triangles …")
        trained = train(
            mesh,
            model_path,
            name=target.name,
            options=TrainingOptions(
                order=_ORDER,
                perturbed_views=_VIEWS,
                held_out_views=_HELD_OUT_VIEWS,
                contour_radii=_SHELLS,
                shadowed_silhouettes=False,  # the Sun is behind the camera
                seed=seed,
            ),
            camera=camera,
            symmetries=target.symmetries,
            jobs=jobs,
            progress=progress,
        )
        console.print(summary(trained), style="dim")
        model = trained.model
        console.print(f"2. Simulating an approach around it and to its ring: {frames} frames …")
        path, last = _approach(model, ring, frames, seed)
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
        write_echoes(output / "laser.jsonl", mesh, path[last:], _RANGER, seed)
        compiled.wait()  # else the first frame compiles, and its time says so
        console.print("3. Finding the first pose without a prior, and tracking …")
        sequence = open_sequence(output / "scene")
        observations: list[AppearanceObservation] = []
        tracked = _track(model, sequence, output, observations, progress)
        console.print("4. Finding the ring, and fusing camera, ring and laser ranger …")
        contact = fuse_to_contact(
            sequence.frames[last:],
            observations[last:],
            ring,
            output / "laser.jsonl",
            mesh=model.beam_mesh(),
            log=output / "state.jsonl",
            video=output / "ring.webm",
        )
    evaluation = evaluate_rows(sequence, tracked.rows, target.symmetries, model.centre_m)
    report = write_report(
        output,
        target_name=target.name,
        model=model,
        sequence=sequence,
        observations=observations,
        evaluation=evaluation,
        more=[
            _film(output / "approach.webm", "The approach", "Edges of the model and the axes at "
                  "each pose; the ellipse is 1 σ of the centre, enlarged as it says."),
            _film(output / "ring.webm", "The docking ring", "Ellipses found; orange: the ring, "
                  "purple: a circle that may be it, no pose is given. Green: the axis."),
            Card("contact", "To the docking ring", "Errors of the ring's centre on the last "
                 "metres. The ring takes over where the picture no longer holds the target.",
                 png(contact_picture(contact))),
        ],
    )  # fmt: skip
    console.print(evaluation.as_table())
    console.print(
        f"{contact.range_m[-1]:.1f} m from the ring, the fused state's place of it is off by "
        f"{1e3 * contact.errors_m['fused'][-1]:.1f} mm (σ {1e3 * contact.sigma_m[-1]:.1f} mm); "
        f"{time.perf_counter() - start:.0f} s in all"
    )
    console.print("5. Flying to the ring in a closed loop, with modelled readings …")
    (fly,) = metadata.entry_points(group=GROUP, name="fly")
    fly.load()(_TARGET, output=output / "flight")
    console.print(f"Report with videos: {report}")
    console.print(
        "The same run on the service's page, at http://127.0.0.1:8360/:\n"
        f"  rendezview serve {model_path} --source {output / 'scene'}"
    )


def _approach(
    model: ViewModel, ring: DockingRing, frames: int, seed: int
) -> tuple[list[TimedPose], int]:
    """Half around the target, then along the ring's axis; and the first frame of that."""
    around = round(_AROUND * frames)
    jitter, last_jitter = (float(np.deg2rad(degrees)) for degrees in _JITTER_DEG)
    first, last = (radii * model.sphere_radius_m for radii in _RANGES)
    flown = trajectory(
        "flyaround",
        TrajectoryOptions(
            frames=2 * around - 1,
            dt_s=_STEP_S,
            start_range_m=first,
            end_range_m=last,
            centre_m=triple(model.centre_m),
            pointing_jitter_rad=jitter,
            roll_jitter_rad=jitter,
            seed=seed,
        ),
    )[:around]  # the nearest frame is half-way around, on the ring's side
    place = flown[-1][1].inverse().translation_m
    final = trajectory(
        "vbar",
        TrajectoryOptions(
            frames=frames - around + 1,
            dt_s=_STEP_S,
            start_range_m=float(np.linalg.norm(place - ring.centre_m)),
            end_range_m=_LAST_M,
            centre_m=triple(ring.centre_m),
            approach_axis=triple(ring.axis),
            hops=0,
            pointing_jitter_rad=last_jitter,
            roll_jitter_rad=last_jitter,
            seed=seed + 1,
        ),
    )
    # The camera keeps its roll from the one path to the other.
    turned = so3.exp(np.array([0.0, 0.0, _roll(final[0][1], flown[-1][1])]))
    rolled = Pose(turned, np.zeros(3))
    after = ((flown[-1][0] + time_s, rolled @ pose) for time_s, pose in final[1:])
    return [*flown, *after], around


def _roll(pose: Pose, other: Pose) -> float:
    """The roll of the camera, rad, that brings the first attitude nearest to the second."""
    between = other.rotation @ pose.rotation.T
    return math.atan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])


def _track(
    model: ViewModel,
    sequence: Sequence,
    output: Path,
    observations: list[AppearanceObservation],
    progress: ProgressBar,
) -> Summary:
    """Track the sequence into a log, results and a video; fills ``observations``."""

    def lines() -> Iterator[Line]:
        with video_of(output / "approach.webm", sequence, model) as video:
            for frame, observation in follow(model, sequence, watch=video.watch):
                observations.append(observation)
                row = result_row(sequence.scene_id, frame, observation)
                yield Line(record(frame, observation), observation.status, row)

    return run(
        lines(),
        log=output / "log.jsonl",
        results=output / "poses.csv",
        progress=progress.stage("tracking", len(sequence)),
    )


def _film(path: Path, title: str, words: str) -> Card:
    video = cv2.VideoCapture(str(path))
    width, height = (video.get(k) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    video.release()
    tall = height / width if width > 0.0 else None
    return Card(path.stem, title, words, path.read_bytes(), WEBM, tall)
