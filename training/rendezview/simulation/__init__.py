"""Camera frames of a target in space, with the truth of every one."""

from rendezview.simulation.background import Earth, Stars
from rendezview.simulation.mitsuba_renderer import MitsubaOptions
from rendezview.simulation.scene import SceneOptions, render_frame, simulate, sun_at_phase
from rendezview.simulation.sensor import SensorOptions, automatic_exposure, expose
from rendezview.simulation.shading import Rendering, ShadingOptions, render
from rendezview.simulation.trajectories import (
    TrajectoryKind,
    TrajectoryOptions,
    looking_at,
    torque_free,
    trajectory,
)

__all__ = [
    "Earth",
    "MitsubaOptions",
    "Rendering",
    "SceneOptions",
    "SensorOptions",
    "ShadingOptions",
    "Stars",
    "TrajectoryKind",
    "TrajectoryOptions",
    "automatic_exposure",
    "expose",
    "looking_at",
    "render",
    "render_frame",
    "simulate",
    "sun_at_phase",
    "torque_free",
    "trajectory",
]
