"""The port, and the envelope of contact: each limit on its own."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry import so3
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.target import Target
from rendezview_ground.fly.options import EnvelopeOptions, FlyPlan, PortOptions, load_fly_plan
from rendezview_ground.fly.port import Contact, Port, Relative
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.near_spheres import near_spheres

GOOD = Contact(0.02, 0.01, 0.01, 0.075, 0.005, 0.001, 0.001)
EDGES = {
    "lateral_m": (0.10, "lateral"),
    "tilt_rad": (math.radians(4.0), "tilt"),
    "roll_rad": (math.radians(4.0), "roll"),
    "closing_m_s": (0.10, "closing fast"),
    "lateral_m_s": (0.04, "lateral speed"),
    "across_rad_s": (math.radians(0.2), "rate across"),
    "about_rad_s": (math.radians(0.2), "rate about"),
}


@pytest.mark.parametrize("name", EDGES)
def test_each_limit_of_the_docking_standard_counts(name: str):
    limit, words = EDGES[name]
    envelope = EnvelopeOptions()
    assert replace(GOOD, **{name: 0.999 * limit}).outside(envelope) is None
    assert replace(GOOD, **{name: 1.001 * limit}).outside(envelope) == words
    margin = replace(Contact(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), **{name: 0.01 * limit})
    assert replace(GOOD, **{name: 0.995 * limit}).outside(envelope, margin) == words


def test_too_slow_a_contact_is_outside():
    assert replace(GOOD, closing_m_s=0.049).outside(EnvelopeOptions()) == "closing slow"


def test_a_chaser_on_the_axis_is_aligned():
    port = Port.of(find_target("client"), FlyPlan())
    camera = port.centre_m + 3.0 * port.axis
    pose = Pose(port.facing, -port.facing @ camera)
    at = Relative.of(port, pose, np.zeros(6), np.zeros(3))
    assert at.range_m == pytest.approx(2.0)
    np.testing.assert_allclose([*at.aside_m, *at.turn], 0.0, atol=1e-12)
    turned = Pose(so3.exp(np.array([0.0, 0.0, 0.05])) @ pose.rotation, pose.translation_m)
    contact = Contact.of(port, Relative.of(port, turned, np.zeros(6), np.zeros(3)))
    assert contact.roll_rad == pytest.approx(0.05)


def test_a_target_without_a_ring_needs_a_port():
    with pytest.raises(RendezviewError, match=r"port\.centre_m"):
        Port.of(find_target("hubble"), FlyPlan())
    plan = FlyPlan(port=PortOptions(centre_m=(-6.8, 0.0, 0.0), axis=(-2.0, 0.0, 0.0)))
    port = Port.of(find_target("hubble"), plan)
    assert port.ring is None
    np.testing.assert_allclose(port.axis, [-1.0, 0.0, 0.0])


@pytest.mark.parametrize(("x_m", "refused"), [(1.5, False), (1500.0, True)])
def test_a_port_in_millimetres_is_refused(bumpy_mesh, x_m: float, refused: bool):
    plan = FlyPlan(port=PortOptions(centre_m=(x_m, 0.0, 0.0), axis=(1.0, 0.0, 0.0)))
    port = Port.of(Target("bumpy", "", None, "m"), plan)
    with pytest.raises(RendezviewError, match="in metres") if refused else nullcontext():
        port.must_be_on(bumpy_mesh)


def test_an_unknown_key_of_the_plan_is_an_error(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text("[guidance]\nslope_per_s = 0.01\n")
    assert load_fly_plan(path).guidance.slope_per_s == 0.01
    path.write_text("[guidance]\nslop = 0.01\n")
    with pytest.raises(RendezviewError, match="slop"):
        load_fly_plan(path)


@pytest.mark.parametrize(
    "line",
    ["port.axis = [0, 0, inf]", "sensors.laser_origin_m = [0, nan, 0]", "chaser.start_m = nan"],
)
def test_a_number_of_the_plan_that_is_none_is_an_error(tmp_path, line: str):
    (tmp_path / "plan.toml").write_text(line + "\n")
    with pytest.raises(RendezviewError, match="finite"):
        load_fly_plan(tmp_path / "plan.toml")


def test_a_port_without_a_ring_gets_two_spheres_of_near_views(bumpy_mesh):
    plan = FlyPlan(port=PortOptions(centre_m=(1.5, 0.0, 0.0), axis=(2.0, 0.0, 0.0)))
    port = Port.of(Target("bumpy", "", None, "m"), plan)
    options = TrainingOptions(order=2)
    whole = view_geometry(bumpy_mesh, options, None)
    large, small = near_spheres(whole, options, port.circle(bumpy_mesh), None)
    for sphere in (large, small):
        np.testing.assert_allclose(sphere.geometry.centre_m, port.centre_m)
        assert (sphere.directions @ port.axis).min() > 0.0
    assert small.shells_m[-1] > large.shells_m[0]  # no gap between them
