"""What the flights to one target share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rendezview.fusion import BeamMesh
from rendezview.geometry.camera import Camera
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.beacons import ReflectorPattern, patterns_of
from rendezview_ground.fly.lights import StereoPair
from rendezview_ground.fly.options import FlyPlan
from rendezview_ground.fly.port import Port
from rendezview_ground.mesh.mesh import Mesh

# Source: `fusion-approach`, of which the error tables are
CAMERA = Camera(1024, 1024, 800.0, 800.0, 511.5, 511.5)


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """All that the flights to one target share."""

    plan: FlyPlan
    port: Port
    mesh: Mesh
    beam: BeamMesh
    patterns: tuple[ReflectorPattern, ...]
    target: Target
    model: ViewModel | None = None  # None: modelled sensors, no frames

    @classmethod
    def of(cls, target: Target, mesh: Mesh, plan: FlyPlan, model: ViewModel | None = None) -> Setup:
        """Of a target with a port, see `Port.of`."""
        beam = BeamMesh(mesh.vertices_m.astype(np.float64), mesh.faces)
        patterns = tuple(patterns_of(target)) if target.reflectors else ()
        port = Port.of(target, plan)
        port.must_be_on(mesh)
        return cls(plan, port, mesh, beam, patterns, target, model)

    def stereo_pair(self) -> StereoPair | None:
        """A fresh one, for one flight; None: the target has no lights."""
        baseline_m = self.plan.sensors.stereo_baseline_m
        return StereoPair(CAMERA, baseline_m, self.target, self.beam) if self.target.leds else None
