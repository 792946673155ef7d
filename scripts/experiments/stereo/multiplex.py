"""Lights that shine one after the other, on a target that turns: errors with and without times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rendezview.sensors.stereo import StereoTracker
from rendezview.sensors.stereo.multiplex import MultiplexedTracker
from rendezview.simulation.led_laboratory import LaboratoryOptions
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD, nees, show, table_of
from experiments.peers.pnp import PEERS
from experiments.peers.pnp import rig as by_peers
from experiments.stereo.plain import Simulator, Truth, laboratory
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import between
from rendezview.io.target import Target
from rendezview.sensors.observation import Status

SLOT_S, READING_S = 1.0 / 60.0, 0.1
_SETTLED = 10  # readings before the errors count


@dataclass(frozen=True)
class Errors:
    """Of the readings after the first second."""

    turn_deg: float  # median
    light_mm: float  # median of the farthest light
    nees: float  # mean; 6 is right
    poses: int  # of all readings, the first ones too
    peers_mm: tuple[float, ...]  # median of the farthest light by peers, who take all as at once


def turning(rate_rad_s: float) -> Callable[[float], Pose]:
    """rig_from_target of a stage that turns and swings by 0.1 m."""

    def at(time_s: float) -> Pose:
        turn = Rotation.from_rotvec([0.0, 0.0, rate_rad_s * time_s]).as_matrix()
        return Pose(turn, np.array([0.1 * np.sin(0.5 * time_s), 0.0, 0.0]))

    return at


def errors(
    laboratory: Truth, rate_deg_s: float, corrected: bool, readings: int, seed: int
) -> Errors:
    """Errors of a run at one rate, ten readings a second."""
    at, rng = turning(np.deg2rad(rate_deg_s)), np.random.default_rng(seed)
    plain = StereoTracker(laboratory.rig, laboratory.leds)
    offsets = SLOT_S * np.arange(len(laboratory.leds))
    tracker = MultiplexedTracker(plain, offsets) if corrected else plain
    first, known = laboratory.rig.cameras[0].camera_from_rig, 0
    turns, lights, squares = [], [], []
    peers: dict[str, list[float]] = {name: [] for name in PEERS}
    for k in range(readings):
        time_s = READING_S * k
        currents = laboratory.scan(at, time_s + offsets, rng)
        spots = [
            camera.photodiode.read(seen)
            for camera, seen in zip(laboratory.rig.cameras, currents, strict=True)
            if camera.photodiode is not None
        ]
        if k >= _SETTLED:
            sights = laboratory.rig.sights(spots, len(laboratory.leds))
            for name, pose in by_peers(laboratory.leds, sights, laboratory.rig).items():
                if pose is not None:
                    gap = pose.apply(laboratory.leds) - at(time_s).apply(laboratory.leds)
                    peers[name].append(float(np.linalg.norm(gap, axis=1).max()))
        found = tracker.update(time_s, spots)
        if found.status is not Status.OK or found.pose is None:
            continue
        known += 1
        if k < _SETTLED:
            continue
        truth = first @ at(time_s)
        turn = between(found.pose.rotation, truth.rotation)
        off = np.append(turn, found.pose.translation_m - truth.translation_m)
        apart = found.pose.apply(laboratory.leds) - truth.apply(laboratory.leds)
        turns.append(np.linalg.norm(turn))
        lights.append(np.linalg.norm(apart, axis=1).max())
        squares.append(nees(off, found.covariance))
    peers_mm = tuple(float(1e3 * np.median(gaps)) for gaps in peers.values())
    if not turns:
        return Errors(np.nan, np.nan, np.nan, known, peers_mm)
    return Errors(
        float(np.rad2deg(np.median(turns))), float(1e3 * np.median(lights)),
        float(np.mean(squares)), known, peers_mm,
    )  # fmt: skip


def laboratory_of(signal_to_noise: float, seed: int, simulator: Simulator = "own") -> Truth:
    """SCOLE's six lights before two perfect photodiodes."""
    leds = np.array([led.position_m for led in Target.load(MODELS_CAD / "scole").leds])
    options = LaboratoryOptions(signal_to_noise=signal_to_noise, distorted=False)
    return laboratory(simulator, leds, options, seed)


def run(
    *, readings: int = 100, snr: float = 4000.0, seed: int = 16, simulator: Simulator = "own"
) -> None:
    """Six lights 1/60 s apart, ten readings a second: errors of a turning target.

    Two photodiodes 7 m above the stage. Each reading's pose is compared with the truth at its
    first light. 'as one' takes the lights as simultaneous, as OpenCV's solvePnP (one camera) and
    poselib (both) do with the same lights.
    """
    truth = laboratory_of(snr, seed, simulator)
    table = table_of(
        f"{readings} readings, S/N {snr:g}, seed {seed}, {simulator} simulator",
        "°/s | as one: poses | turn | farthest light, mm | NEES "
        "| in time: poses | turn | farthest light, mm | NEES | solvePnP, poselib, mm",
        left=0,
    )
    for rate in (0.0, 5.0, 20.0, 40.0):
        cells = []
        for corrected in (False, True):
            found = errors(truth, rate, corrected, readings, seed)
            cells += [
                f"{found.poses}", f"{found.turn_deg:.3f}°", f"{found.light_mm:.2f}",
                f"{found.nees:.1f}",
            ]  # fmt: skip
        table.add_row(f"{rate:g}", *cells, ", ".join(f"{gap:.1f}" for gap in found.peers_mm))
    show(table, width=130)
