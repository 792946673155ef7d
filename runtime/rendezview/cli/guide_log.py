"""``rendezview guide``: path, correction and spin from a log of poses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from rendezview.cli.guide import (
    AemFile,
    ChaserFile,
    Epoch,
    Guide,
    OemFile,
    PlanFile,
    ShapeName,
    first_epoch,
)
from rendezview.cli.progress import ProgressBar, say
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.io.bundled import find_target
from rendezview.io.files import check_place
from rendezview.io.pose_log import logged_pose, read_poses
from rendezview.sensors.run import Line, run

_Logged = tuple[float, Pose | None, Array | None]  # time, pose and its covariance


def guide(
    log: Annotated[
        Path, typer.Argument(help="Log (JSON lines) of fuse or track: its poses are followed.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Reports, JSON lines.")],
    plan: PlanFile = None,
    shape: ShapeName = None,
    target: Annotated[
        str | None,
        typer.Option(
            help="Target file with a docking ring, or client: the path is that of the camera "
            "about the ring's centre, else about the target's origin."
        ),
    ] = None,
    chaser: ChaserFile = None,
    oem: OemFile = None,
    aem: AemFile = None,
    epoch: Epoch = None,
) -> None:
    """Fit the path of a log of poses, and say the correction back to a plan.

    \b
    Example: rendezview guide state.jsonl --target client --shape vbar -o guide.jsonl
    """
    check_place(output, "the reports")
    if plan is None and shape is None:
        raise RendezviewError("a --plan or a --shape is needed: what path is flown?")
    name, centre_m = "target", np.zeros(3)
    if target is not None:
        found = find_target(target)
        if found.docking_ring is None:
            raise RendezviewError(f"{target}: this target has no docking_ring: leave --target out")
        name, centre_m = found.name, found.docking_ring.centre_m
    poses = _poses(log)
    moment = first_epoch(epoch, [time_s for time_s, *_ in poses[:1]], bool(oem or aem))
    guided = Guide.of(centre_m, plan, shape, chaser, True)

    def lines() -> Iterator[Line]:
        for time_s, pose, covariance in poses:
            noted, words = guided.update(time_s, pose, covariance)
            if words:
                say(words)
            yield Line({"time_s": time_s, "trajectory": noted})

    with ProgressBar() as bar:
        run(lines(), log=output, progress=bar.stage("poses", len(poses)))
    guided.finish(oem, aem, moment, name)


def _poses(path: Path) -> list[_Logged]:
    """The poses of a log, in order of time; of several at one time the last.

    Raises:
        RendezviewError: missing, or a line that is of no log of poses.
    """
    found: dict[float, _Logged] = {}

    def take(record: dict[str, Any]) -> None:
        given, time_s = record["pose"], float(record["time_s"])
        if found and time_s < next(reversed(found)):
            raise ValueError("times must rise")
        known = given is not None and record["covariance"] is not None
        found[time_s] = (time_s, *(logged_pose(record) if known else (None, None)))

    read_poses(path, take)
    return list(found.values())
