"""Several cameras and their pictures, from a file; a run that switches between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, FiniteFloat, TypeAdapter

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import load_camera
from rendezview.io.files import StrPath, checked, read_toml
from rendezview.io.sequences import open_sequence
from rendezview.sensors.beacons.accelerations import Accelerations
from rendezview.sensors.beacons.cameras import RangedCamera, SwitchingSensor
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.difference import LitDark, ThresholdOptions
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.beacons.rig_files import PoseTable, Table
from rendezview.sensors.beacons.run import FramePair, Mode, pair_up
from rendezview.sensors.beacons.tracker import ReflectorSensor
from rendezview.sensors.observation import Status


class _CameraTable(Table):
    name: Annotated[str, Field(min_length=1)]
    camera: str | None = None
    frames: Annotated[list[str], Field(min_length=1, max_length=2)]
    nearest_m: FiniteFloat
    farthest_m: FiniteFloat
    camera_from_chaser: PoseTable | None = None


class _File(Table):
    cameras: Annotated[list[_CameraTable], Field(min_length=1)]


_ADAPTER = TypeAdapter(_File)


@dataclass(frozen=True, slots=True, eq=False)
class CameraRun:
    """One camera of a set: where it is for, how it is mounted, and its readings."""

    name: str
    nearest_m: float
    farthest_m: float
    camera_from_chaser: Pose
    pairs: list[FramePair]


@dataclass(frozen=True, slots=True, eq=False)
class SetReading:
    """One moment of a set of cameras."""

    camera: str
    pair: FramePair
    frames: LitDark | None
    observation: ReflectorObservation
    chaser_from_target: Pose | None


def load_cameras(
    path: StrPath, mode: Mode | None = None, *, invert: bool = False
) -> list[CameraRun]:
    """The cameras of a set and their pictures; places in the file are relative to it.

    Args:
        path: a TOML file with a table ``[[cameras]]`` each: ``name``, ``camera`` (its file),
            ``frames`` (one or two places), ``nearest_m``, ``farthest_m``, ``camera_from_chaser``.
        mode: how pictures make readings; two places are a splitter, one holds both in turn.
        invert: dark dots on a bright ground.

    Raises:
        RendezviewError: missing, an unknown or wrong key, pictures that cannot be opened, or
            cameras that do not have as many readings as the first.
    """
    file = checked(_ADAPTER, read_toml(path, "a set of cameras"), str(path))
    folder, runs = Path(path).parent, []
    for table in file.cameras:
        camera = load_camera(folder / table.camera) if table.camera else None
        sequences = [open_sequence(folder / place, camera) for place in table.frames]
        chosen = mode or (Mode.SPLITTER if len(sequences) == 2 else Mode.PAIRS)
        mount = Pose.identity()
        if table.camera_from_chaser is not None:
            with explained(f"{path}: camera {table.name!r}: "):
                mount = table.camera_from_chaser.pose()
        pairs = pair_up(sequences, chosen, None, invert)
        runs.append(CameraRun(table.name, table.nearest_m, table.farthest_m, mount, pairs))
    for run in runs[1:]:
        if len(run.pairs) != len(runs[0].pairs):
            raise RendezviewError(
                f"{path}: camera {run.name!r} has {len(run.pairs)} readings and "
                f"{runs[0].name!r} {len(runs[0].pairs)}: all take each reading at the same time"
            )
    return runs


def follow_cameras(
    runs: list[CameraRun],
    patterns: list[ReflectorPattern],
    *,
    threshold: ThresholdOptions | None = None,
    acquisition: AcquisitionOptions | None = None,
    accelerations: Accelerations | None = None,
) -> Iterator[SetReading]:
    """One reading for each moment, by the camera in use; another one where its picture fails.

    ``accelerations`` are in the chaser's frame.

    Raises:
        RendezviewError: ranges with a gap, or times that do not rise.
    """
    switching = SwitchingSensor(
        [
            RangedCamera(
                run.name,
                ReflectorSensor(
                    run.pairs[0].lit.camera, patterns, threshold=threshold, acquisition=acquisition
                ),
                run.camera_from_chaser, run.nearest_m, run.farthest_m,
            )
            for run in runs if run.pairs
        ]
    )  # fmt: skip
    by_name = {run.name: run for run in runs}
    last_s = -float("inf")
    for index in range(len(runs[0].pairs)):
        time_s = by_name[switching.active.name].pairs[index].time_s
        time_s = float(index) if time_s is None else time_s
        if not time_s > last_s:
            raise RendezviewError(f"reading {index}: its time, {time_s} s, does not rise")
        last_s = time_s
        yield _moment(switching, by_name, index, time_s, accelerations)


def _moment(
    switching: SwitchingSensor, runs: dict[str, CameraRun], index: int, time_s: float,
    accelerations: Accelerations | None,
) -> SetReading:  # fmt: skip
    """The reading of the first camera whose picture can be read."""
    reasons = []
    for _ in runs:
        name = switching.active.name
        pair = runs[name].pairs[index]
        try:
            frames = pair.read()
        except RendezviewError as error:
            reasons.append(f"{name}: {error}")
            switching.fail(time_s)
            continue
        push = accelerations.at(time_s) if accelerations else None
        if push is not None:  # from the chaser's frame to the camera's
            push = (push.reshape(2, 3) @ runs[name].camera_from_chaser.rotation.T).ravel()
        observation, pose = switching.update(time_s, frames, push)
        observation = replace(observation, time_s=pair.time_s)
        if reasons and observation.reason is None:
            observation = replace(observation, note="; ".join(reasons))
        return SetReading(name, pair, frames, observation, pose)
    unread = ReflectorObservation(Status.UNREADABLE, "; ".join(reasons), time_s=pair.time_s)
    return SetReading(name, pair, None, unread, None)
