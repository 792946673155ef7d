"""The flight's plan: one validated table of every number, read from ``plan.toml``."""

from __future__ import annotations

import math
from dataclasses import field
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field, TypeAdapter
from pydantic.dataclasses import dataclass

from rendezview.io.files import checked, read_toml

# An unknown key is an error, and so is a number that is none.
_FORBID = ConfigDict(extra="forbid", allow_inf_nan=False)
_Positive = Annotated[float, Field(gt=0.0)]
_Least0 = Annotated[float, Field(ge=0.0)]
_Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, config=_FORBID)
class PortOptions:
    """The place to dock at, target frame; left out: the target's docking ring."""

    centre_m: _Triple | None = None
    axis: _Triple | None = None  # outwards, towards the chaser
    radius_m: _Positive | None = None  # of a ring there; left out: no ring sensor


@dataclass(frozen=True, kw_only=True, config=_FORBID)
class TargetOptions:
    """Orbit and rotation of the target; its port faces along the orbital velocity."""

    mean_motion_rad_s: _Least0 = 1.1e-3  # Source: a circular orbit at 540 km, as Hubble's
    drag_m_s2: _Least0 = 2e-5  # chaser's over target's. Source: tests of the trajectory's loop
    attitude_sigma_deg: _Least0 = 1.0  # each axis, at the start. Source: `fusion-approach`
    rate_sigma_deg_s: _Least0 = 0.01  # each axis, against the orbit's frame. Source: chosen
    # Principal moments on the target's axes, any unit. Source: a bus with wings along Y
    inertia: tuple[_Positive, _Positive, _Positive] = (1.5, 1.0, 1.5)
    sun_phase_deg: tuple[_Least0, _Least0] = (0.0, 60.0)  # Sun, target, chaser, at the start


@dataclass(frozen=True, kw_only=True, config=_FORBID)
class ChaserOptions:
    """Body, thrusters and attitude control of the chaser. One σ each where not said otherwise."""

    start_m: _Positive = 60.0  # camera to port plane. Source: `fusion-approach`
    place_sigma_m: _Least0 = 0.3  # each axis, at the start. Source: tests of the trajectory's loop
    velocity_sigma_m_s: _Least0 = 0.004  # the same
    port_ahead_m: _Positive = 1.0  # docking plane before the camera. Source: nearest frame measured
    mass_behind_m: _Least0 = 1.5  # centre of mass behind the camera. Source: chosen
    thrust_m_s2: _Positive = 0.02  # of each direction. Source: 20 N on a tonne
    least_on_s: _Least0 = 0.02  # minimum impulse bit. Source: valves of 20 N thrusters
    thrust_scale: _Least0 = 0.02  # error of all impulses. Source: tests of the trajectory's loop
    thrust_scale_each: _Least0 = 0.01  # new in each impulse; the same source
    thrust_askew_deg: _Least0 = 0.5  # about each axis; the same source
    plume_m: _Least0 = 5.0  # port to port, below which braking is limited. Source: chosen
    plume_share: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5  # of the thrust. Source: canted 60°
    attitude_s: _Positive = 1.0  # lag of the attitude control's rate. Source: chosen
    jitter_deg: _Least0 = 0.1  # each axis. Source: the requirement
    jitter_s: _Positive = 20.0  # its period. Source: chosen, of a jet-controlled limit cycle
    gyro_deg_s: _Least0 = 0.01  # noise of a reading. Source: `fusion-faults`
    gyro_bias_deg_s: _Least0 = 0.001  # constant in a flight. Source: chosen, a tenth


@dataclass(frozen=True, kw_only=True, config=_FORBID)
class GuidanceOptions:
    """Glide slope, corridor, hold points, and when to wait or turn back."""

    step_s: _Positive = 0.5  # of control, of gyroscope and thrusters. Source: chosen
    slope_per_s: _Positive = 0.012  # closing speed over distance. Source: 60 m in 240 s
    fastest_m_s: _Positive = 0.4  # closing. Source: 60 m in 240 s
    contact_m_s: _Positive = 0.075  # closing. Source: middle of the envelope
    corridor_deg: _Positive = 10.0  # half angle of the cone. Source: usual, Fehse 2003, ch. 2
    corridor_m: _Positive = 0.1  # its radius at the port. Source: the envelope
    holds_m: tuple[_Positive, ...] = (59.0, 30.0, 10.0, 3.0)  # gates, port to port. Source: chosen
    commit_m: _Positive = 1.0  # port to port, below which contact must be certain. Source: chosen
    settle_s: _Least0 = 5.0  # without doubt, before it goes on. Source: the filter's own alarm
    patience_s: _Positive = 60.0  # of a hold, then retreat. Source: twice the longest fault
    retreats: Annotated[int, Field(ge=0)] = 3  # then it aborts. Source: chosen
    longest_s: _Positive = 900.0  # of a flight, then it is held. Source: chosen


@dataclass(frozen=True, kw_only=True, config=_FORBID)
class SensorOptions:
    """How often each sensor reads, and what has no measured table."""

    frame_s: _Positive = 2.0  # recognizer, ring, reflectors. Source: `fusion-approach`
    laser_s: _Positive = 1.0  # Source: chosen
    laser_m: _Positive = 0.02  # noise. Source: `fusion-approach`
    laser_origin_m: _Triple = (0.3, 0.0, 0.0)  # camera frame. Source: `fusion-approach`
    # Correlation of the part of a modelled error that lasts. Source: `fusion-approach --flights`,
    # the recognizer's 0.15, 0.17, 0.12, 0.10 after 1, 2, 5, 10 frames
    lasting_s: _Positive = 40.0
    reflector_px: _Positive = 0.0144  # centroid error. Source: `reflector-accuracy`
    reflector_bound: _Positive = 1.2  # error over its Cramér–Rao bound. Source: the same, 3 m
    reflectors_m: _Positive = 12.0  # farthest. Source: the same
    stereo_baseline_m: _Positive = 0.5  # of the pair that looks at lights. Source: chosen
    stereo_m: _Positive = 50.0  # farthest. Source: the lights of `scole` merge in pictures at 60 m
    led_px: _Positive = 0.006  # of a light's place. Source: `find_spots` on drawn lights
    led_scene: _Least0 = 0.05  # exposure of lights over that of frames. Source: chosen
    prior_deg: _Least0 = 8.0  # error of the recognizer's first prior. Source: `fusion-approach`


@dataclass(frozen=True, kw_only=True, config=_FORBID)
class EnvelopeOptions:
    """Contact conditions: International Docking System Standard, initial contact conditions."""

    lateral_m: _Positive = 0.10
    angle_deg: _Positive = 4.0  # of the axes, and of roll
    closing_m_s: tuple[_Positive, _Positive] = (0.05, 0.10)
    lateral_m_s: _Positive = 0.04
    rate_deg_s: _Positive = 0.2  # across the axis, and about it


@dataclass(frozen=True, kw_only=True, config=_FORBID)
class FlyPlan:
    """All numbers of a flight."""

    port: PortOptions = field(default_factory=PortOptions)
    target: TargetOptions = field(default_factory=TargetOptions)
    chaser: ChaserOptions = field(default_factory=ChaserOptions)
    guidance: GuidanceOptions = field(default_factory=GuidanceOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    envelope: EnvelopeOptions = field(default_factory=EnvelopeOptions)

    @property
    def steps(self) -> int:
        """Control steps of the longest flight."""
        return math.ceil(self.guidance.longest_s / self.guidance.step_s)


_PLAN = TypeAdapter(FlyPlan)


def load_fly_plan(path: Path | None) -> FlyPlan:
    """The plan of a TOML file; ``None``: the defaults.

    Raises:
        RendezviewError: missing, not TOML, an unknown or wrong key.
    """
    if path is None:
        return FlyPlan()
    return checked(_PLAN, read_toml(path, "a flight plan"), str(path))
