"""What the cameras of a rig see of a target's lights along a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.estimation.motion import extrapolate, rates_between
from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import make_folder
from rendezview.io.results import JsonLinesWriter
from rendezview.io.sequences.images import write_png
from rendezview.io.target import Target
from rendezview.sensors.beacons import Photodiode, Rig, RigCamera
from rendezview_ground.simulate.led_laboratory import electrode_currents
from rendezview_ground.simulate.led_pictures import PictureOptions, draw
from rendezview_ground.simulate.scene import Progress
from rendezview_ground.simulate.trajectories import TimedPose

_ROUNDS = 30  # of the inverse response, at most. Source: by construction, three do
_SPOT_SIGMA_PX = 0.02  # px, of spots in a file. Source: by construction, S/N 100 and σ of 1.5 px


def simulate_lights(
    target: Target,
    rig: Rig,
    poses: Sequence[TimedPose],
    folder: Path,
    seed: int,
    *,
    options: PictureOptions | None = None,
    multiplex_s: float = 0.0,
    progress: Progress | None = None,
) -> None:
    """Write what ``stereo track`` reads: pictures of each camera, or ``readings.jsonl``.

    Picture cameras give pictures, or spots with names where the lights shine one after the other;
    photodiodes give currents. ``truth.jsonl`` has the poses. A light is visible where it faces.

    Args:
        target: with its LEDs.
        rig: calibrated cameras; the poses are those of the first.
        poses: camera_from_target and their times.
        folder: to write into.
        seed: of the noise.
        options: of pictures; size is that of the rig's cameras.
        multiplex_s: from one light to the next of a reading.
        progress: called with the number of readings done.

    Raises:
        RendezviewError: no LEDs, both kinds of cameras, or a camera of unknown picture size.
    """
    if not target.leds:
        raise RendezviewError(f"target {target.name!r} has no LEDs: add [[leds]] to its file")
    diodes = [camera.photodiode is not None for camera in rig.cameras]
    if any(diodes) and not all(diodes):
        raise RendezviewError("this rig has photodiodes and picture cameras: simulate one kind")
    if not any(diodes) and any(camera.size is None for camera in rig.cameras):
        raise RendezviewError("this rig does not say how large its pictures are: calibrate it")
    chosen, rng = options or PictureOptions(), np.random.default_rng(seed)
    first = rig.cameras[0].camera_from_rig.inverse()
    make_folder(folder)
    pictures = not any(diodes) and multiplex_s == 0.0
    log = None if pictures else JsonLinesWriter(folder / "readings.jsonl")
    with JsonLinesWriter(folder / "truth.jsonl") as truth:
        for k, (time_s, pose) in enumerate(poses):
            lights = _lights(target, poses, k, multiplex_s)
            truth.write({"im_id": k, "time_s": time_s, "camera_from_target": pose,
                         "rig_from_target": first @ pose})  # fmt: skip
            seen = [_facing(camera, first, *lights) for camera in rig.cameras]
            if log is None:
                for number, (camera, places) in enumerate(zip(rig.cameras, seen, strict=True)):
                    make_folder(folder / camera.name)
                    picture = draw(
                        rig, number, places[np.isfinite(places).all(axis=1)], chosen, rng
                    )
                    write_png(folder / camera.name / f"{k:06d}.png", picture)
            else:
                log.write({"time_s": time_s} | _reading(target, rig, seen, rng))
            if progress is not None:
                progress(k + 1, len(poses))
    if log is not None:
        log.keep()


def _lights(
    target: Target, poses: Sequence[TimedPose], k: int, multiplex_s: float
) -> tuple[Array, Array]:
    """Places and beams (L, 3) of the lights, each at its own time, first camera's frame."""
    places, beams = [], []
    for number, led in enumerate(target.leds):
        pose = _later(poses, k, number * multiplex_s)
        places.append(pose.apply(led.position_m))
        beams.append(pose.rotation @ led.normal)
    return np.array(places), np.array(beams)


def _later(poses: Sequence[TimedPose], k: int, after_s: float) -> Pose:
    """The pose some time after the k-th, by the motion to the next one (of the last, before)."""
    _, pose = poses[k]
    if after_s == 0.0 or len(poses) < 2:
        return pose
    (begin_s, begin), (end_s, end) = (
        poses[k : k + 2] if k + 1 < len(poses) else poses[k - 1 : k + 1]
    )
    return extrapolate(pose, rates_between(begin, end, end_s - begin_s), after_s)


def _facing(camera: RigCamera, rig_from_first: Pose, places: Array, beams: Array) -> Array:
    """(L, 3) places in the rig frame; NaN where a light shines away from the camera."""
    in_rig = rig_from_first.apply(places)
    away = in_rig - camera.camera_from_rig.inverse().translation_m
    shines = np.einsum("ij,ij->i", beams @ rig_from_first.rotation.T, away) < 0.0
    return np.where(shines[:, None], in_rig, np.nan)


def _reading(
    target: Target, rig: Rig, seen: list[Array], rng: np.random.Generator
) -> dict[str, object]:
    """One line of ``readings.jsonl``: currents of photodiodes, or spots with names."""
    names = [led.name for led in target.leds]
    if rig.cameras[0].photodiode is not None:
        return {
            "currents": [
                [None if np.isnan(row).any() else row for row in _currents(camera, places, rng)]
                for camera, places in zip(rig.cameras, seen, strict=True)
            ]
        }
    spots, leds = [], []
    for camera, places in zip(rig.cameras, seen, strict=True):
        width, height = camera.size or (0, 0)
        found = camera.project(places) + rng.normal(0.0, _SPOT_SIGMA_PX, (len(places), 2))
        with np.errstate(invalid="ignore"):
            inside = np.all((found > 0.0) & (found < (width - 1, height - 1)), axis=1)
        spots.append(found[inside])
        leds.append([names[k] for k in np.flatnonzero(inside)])
    return {"spots": spots, "leds": leds, "sigma_px": _SPOT_SIGMA_PX}


def _currents(camera: RigCamera, places: Array, rng: np.random.Generator) -> Array:
    """(L, 4) currents x1 x2 y1 y2 of a photodiode, whose light is 2; NaN where off it."""
    diode = camera.photodiode
    assert isinstance(diode, Photodiode)
    metres = camera.project(places)
    currents = np.full((len(places), 4), np.nan)
    with np.errstate(invalid="ignore"):
        inside = (np.abs(metres) <= diode.half_width_m).all(axis=1)
    exact = electrode_currents(_ratios(diode, metres[inside]))
    currents[inside] = exact + rng.normal(0.0, diode.noise, exact.shape)
    return currents


def _ratios(diode: Photodiode, metres: Array) -> npt.NDArray[np.float64]:
    """(N, 2) readings of eq. 1, 2 that the response turns into these places, by iteration."""
    ratio = metres / diode.half_width_m
    for _ in range(_ROUNDS):
        light = electrode_currents(ratio)
        step = (metres - diode.response.positions(light)) / diode.half_width_m
        ratio = ratio + step
        if not len(step) or np.abs(step).max() < 1e-12:
            break
    return np.asarray(ratio)
