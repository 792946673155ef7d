"""Scenes of a guidance sensor: a lit and a dark picture of the vehicle at every pose."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.file_lock import FolderLock
from rendezview.io.results import JsonLinesWriter
from rendezview.io.target import Target
from rendezview.sensors.beacons import LitDark, ReflectorPattern, ReflectorSensor, patterns_of
from rendezview.sensors.beacons.exposure import suggest_exposure
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.ranger import echo
from rendezview_ground.simulate.reflector_frames import (
    Float32s,
    ReflectorFrameOptions,
    exposure,
    reflector_light,
    render_pair,
)
from rendezview_ground.simulate.scene import Progress, SceneOptions, simulate
from rendezview_ground.simulate.trajectories import TimedPose

_STREAM = 3  # random numbers of the integration times, beside those of frames, mesh, ranger
_BEFORE = 0.02  # of the distance: a surface nearer than the reflector by more hides it


class Integration(StrEnum):
    """How the exposure follows the reflectors."""

    AUTOMATIC = "automatic"  # the brightest has its grey level in every picture, up to 40 m
    FIXED = "fixed"  # that of the first picture throughout
    SUGGESTED = "suggested"  # from the first picture's, by the factor that each reading suggests


def without_mesh(target: Target) -> Mesh:
    """A target of which only reflectors or lights are known: nothing else is drawn.

    Its faces have no area; they give a trajectory its centre and size.
    """
    places = [reflector.position_m for reflector in target.reflectors]
    places += [led.position_m for led in target.leds]
    if not places:
        raise RendezviewError(f"target {target.name!r} has no mesh, reflectors or LEDs to draw")
    count = len(places)
    faces = np.repeat(np.arange(count, dtype=np.int32)[:, None], 3, axis=1)
    return Mesh(
        np.array(places, dtype=np.float64), faces, np.zeros((count, 3), np.float32), ()
    )  # fmt: skip


def simulate_reflectors(
    mesh: Mesh,
    target: Target,
    camera: Camera,
    poses: Sequence[TimedPose],
    options: SceneOptions,
    folder: Path,
    seed: int,
    *,
    groups: tuple[str, ...] | None = None,
    integration: Integration = Integration.AUTOMATIC,
    jobs: int = 1,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> None:
    """Write ``folder/lit`` and ``folder/dark``, BOP scenes of the same times and poses.

    Both show the vehicle as `simulate` draws it. The lit picture has the light of the reflectors
    that no surface hides. ``integration.jsonl`` has the exposure of every picture over the first's.

    Raises:
        RendezviewError: the target has no reflectors, or a folder cannot be written.
    """
    patterns = patterns_of(target, groups)
    everything = merged(patterns)
    light = ReflectorFrameOptions(
        blur_sigma_px=max(options.sensor.blur_sigma_px, 0.1),
        noise_sigma_grey=options.sensor.noise_sigma_grey,
        black_level_grey=options.sensor.black_level_grey,
    )
    gains = _gains(patterns, camera, poses, light, integration, seed)
    hidden = [_hidden(mesh, everything, pose) for _, pose in poses]

    def picture(name: str, dark: bool) -> None:
        def painted(number: int, pose: Pose) -> Float32s:
            return reflector_light(
                camera, everything, pose, light, gains[number], hidden[number], dark=dark
            )

        def report(done: int, total: int) -> None:
            if progress is not None:
                progress(dark * total + done, 2 * total)

        simulate(
            mesh, camera, poses, options, folder / name, seed, jobs=jobs, overwrite=overwrite,
            light=painted, again=dark, progress=report,
        )  # fmt: skip

    with FolderLock(folder):  # both are of one run
        picture("lit", dark=False)
        picture("dark", dark=True)
        _write_exposures(folder / "integration.jsonl", poses, gains)


def _write_exposures(path: Path, poses: Sequence[TimedPose], gains: Sequence[float]) -> None:
    with JsonLinesWriter(path) as writer:
        for k, ((time_s, _), gain) in enumerate(zip(poses, gains, strict=True)):
            writer.write({"im_id": k, "time_s": time_s, "exposure": gain / gains[0]})


def _gains(
    patterns: list[ReflectorPattern], camera: Camera, poses: Sequence[TimedPose],
    light: ReflectorFrameOptions, integration: Integration, seed: int,
) -> list[float]:  # fmt: skip
    """Grey levels per radiance of every picture."""
    everything = merged(patterns)
    automatic = [exposure(camera, everything, pose, light) for _, pose in poses]
    first = next((gain for gain in automatic if gain > 0.0), None)
    if first is None:
        raise RendezviewError("no reflector faces the camera anywhere on this trajectory")
    if integration is Integration.AUTOMATIC:
        return [gain or first for gain in automatic]
    if integration is Integration.FIXED:
        return [first] * len(poses)
    sensor, rng = ReflectorSensor(camera, patterns), np.random.default_rng([seed, _STREAM])
    gains, gain = [], first
    for time_s, pose in poses:
        gains.append(gain)
        frames = LitDark(*render_pair(camera, everything, pose, light, rng, gain=gain))
        gain *= suggest_exposure(sensor.update(time_s, frames), frames) or 1.0
    return gains


def _hidden(mesh: Mesh, pattern: ReflectorPattern, pose: Pose) -> tuple[int, ...]:
    """Reflectors that a surface of the vehicle covers."""
    hidden = []
    for k, place in enumerate(pose.apply(pattern.positions_m)):
        far = float(np.linalg.norm(place))
        met = echo(mesh, pose, (0.0, 0.0, 0.0), place / far)
        if met is not None and met < far * (1.0 - _BEFORE):
            hidden.append(k)
    return tuple(hidden)
