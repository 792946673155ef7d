"""The last metres of an approach: camera, docking ring and laser ranger in one state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rendezview.fusion import Fusion
from rendezview.fusion.fusion import Estimate
from rendezview.fusion.logs import LogContext, read_log, state_record
from rendezview.geometry.pose import Array
from rendezview.io.results import JsonLinesWriter
from rendezview.io.sequences import Frame
from rendezview.io.target import DockingRing
from rendezview.io.video_file import VideoWriter
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.beam import BeamMesh
from rendezview.sensors.observation import Status
from rendezview.sensors.ring.observation import RingObservation
from rendezview.sensors.ring.overlay import draw_reading
from rendezview.sensors.ring.prior_log import prior_of_pose
from rendezview.sensors.ring.sensor import RingPrior, RingSensor
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    ESTIMATE,
    GREEN,
    MUTED,
    dress,
    legend_below,
    logarithmic,
    new_figure,
)

_RATE_HZ = 5.0  # of the video; slow enough to read the words. Source: chosen to be watchable
# How a sensor's errors are drawn: its name in the legend, colour, marker and line.
_LOOKS = {
    "fused": ("fused", ESTIMATE, "o", "-"),
    "camera": ("camera and CAD model", GREEN, "^", ":"),
    "ring": ("docking ring", ACTIVE, "s", ":"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Errors of the ring's centre, metres, NaN where a sensor gives none."""

    range_m: Array  # (N,) true, camera to ring
    errors_m: Mapping[str, Array]  # (N,) by sensor; "fused": the state
    sigma_m: Array  # (N,) of the state's ring centre, all axes


def fuse_to_contact(
    frames: Sequence[Frame],
    observations: Sequence[AppearanceObservation],
    ring: DockingRing,
    laser: Path,
    *,
    mesh: BeamMesh | None,
    log: Path,
    video: Path,
) -> Contact:
    """Find the ring in frames that are tracked already, and join all three sensors.

    Args:
        frames: with times and true poses.
        observations: of the tracker, one for each frame.
        ring: of the target.
        laser: log of the ranger.
        mesh: of the target, that its beam meets.
        log: the states, as ``rendezview fuse`` writes them.
        video: the ring in every frame.
    """
    camera = frames[0].camera
    sensor = RingSensor(camera, ring.radius_m, circles=ring.circles)
    fusion = Fusion()
    context = LogContext(ring, mesh or ())
    echoes = {m.time_s: m for m in read_log(laser, "laser", context).measurements}
    rows = []
    with JsonLinesWriter(log) as states, VideoWriter(video, _RATE_HZ) as film:
        for frame, observation in zip(frames, observations, strict=True):
            time_s = float(frame.time_s or 0.0)
            fusion.add(observation.measurement("camera"))
            fusion.add(echoes.get(time_s))
            image = frame.read()
            reading = sensor.update(time_s, image, _prior(fusion.state_at(time_s), ring))
            verdict = fusion.add(reading.measurement("ring", ring=ring))
            state = fusion.state_at(time_s)
            states.write(state_record(state, verdict, fusion))
            film.add(draw_reading(image, reading, camera))
            rows.append(_errors(frame, observation, reading, state, ring))
    table = np.array(rows)
    errors = dict(zip(_LOOKS, table[:, 1:4].T, strict=True))
    return Contact(table[:, 0], errors, table[:, 4])


def contact_picture(contact: Contact) -> Figure:
    """Errors of the ring's centre over the range, with the state's own σ."""
    figure = new_figure(9.6, 4.6)
    axes = figure.subplots()
    dress(axes, x="camera to ring, m", y="error of the ring's centre, mm")
    for name, (label, colour, marker, line) in _LOOKS.items():
        axes.plot(
            contact.range_m, 1e3 * contact.errors_m[name], marker + line, color=colour,
            label=label, markersize=5.0, linewidth=1.4,
        )  # fmt: skip
    axes.plot(contact.range_m, 1e3 * contact.sigma_m, "--", color=MUTED, label="σ of the state")
    logarithmic(axes, "x", "235")
    logarithmic(axes, "y")
    axes.invert_xaxis()
    legend_below(figure, axes, columns=4)
    return figure


def _prior(state: Estimate, ring: DockingRing) -> RingPrior | None:
    if state.status is not Status.TRACKING or state.pose is None or state.covariance is None:
        return None
    return prior_of_pose(state.pose, state.covariance[:6, :6], ring)


def _errors(
    frame: Frame,
    observation: AppearanceObservation,
    reading: RingObservation,
    state: Estimate,
    ring: DockingRing,
) -> tuple[float, ...]:
    """Range, errors in the order of `_LOOKS`, and σ of the state."""
    assert frame.camera_from_target is not None
    truth = frame.camera_from_target.apply(ring.centre_m)
    circle = reading.circle
    places = (
        None if state.pose is None else state.pose.apply(ring.centre_m),
        None if observation.pose is None else observation.pose.apply(ring.centre_m),
        None if circle is None else circle.centre_m,
    )
    errors = [math.nan if p is None else float(np.linalg.norm(p - truth)) for p in places]
    return float(np.linalg.norm(truth)), *errors, _sigma_m(state, ring)


def _sigma_m(state: Estimate, ring: DockingRing) -> float:
    """One σ of the ring's centre: R r + t moves by w × R r + v."""
    if state.pose is None or state.covariance is None:
        return math.nan
    arm = state.pose.rotation @ ring.centre_m
    moved = np.hstack([np.cross(np.eye(3), arm).T, np.eye(3)])
    return float(np.sqrt(np.trace(moved @ state.covariance[:6, :6] @ moved.T)))
