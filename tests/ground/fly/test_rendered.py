"""The project's sensors on rendered frames, in the loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rendezview.io.target import Target
from rendezview_ground.fly.dynamics import OrbitDynamics
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.options import ChaserOptions, FlyPlan, GuidanceOptions, PortOptions
from rendezview_ground.fly.rendered import RenderedSensors, stray_light
from rendezview_ground.fly.setup import Setup

PLAN = FlyPlan(
    port=PortOptions(centre_m=(1.5, 0.0, 0.0), axis=(1.0, 0.6, 0.4)),  # three sides are seen
    chaser=ChaserOptions(start_m=8.0, place_sigma_m=0.02),
    guidance=GuidanceOptions(longest_s=4.0),
)


def test_the_recognizer_reads_frames_and_a_dead_camera_gives_none(refining_model, bumpy_mesh):
    target = Target("bumpy", "", None, "m")
    setup = Setup.of(target, bumpy_mesh, PLAN, refining_model)
    truth = OrbitDynamics(PLAN, setup.port, 0).start()

    def read(plan: FlyPlan, fault: Fault | None = None):
        sensors = RenderedSensors(replace(setup, plan=plan), 0, fault)
        return [m for m in sensors.read(truth, None) if m.sensor == "camera"]

    plan = replace(PLAN, target=replace(PLAN.target, sun_phase_deg=(10.0, 20.0)))
    (seen,) = read(plan)
    assert seen.pose.angle_to(truth.pose) < np.deg2rad(2.0)  # the prior is 8° off
    assert read(plan, Fault("camera", 0.0, 30.0, 0.0)) == []
    assert read(plan, Fault("glare", 0.0, 30.0, 1e4)) == []


def test_stray_light_falls_from_a_side_that_is_drawn():
    one, other = stray_light(400.0, 0), stray_light(400.0, 1)
    assert one.max() == pytest.approx(400.0)
    assert 0.0 < one.min() < 0.15 * one.max()
    assert np.abs(one - other).max() > 10.0
