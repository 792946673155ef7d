"""Plan files, and corrections towards them."""

import math

import numpy as np
import pytest
from tests.trajectory.paths import TIMES, refined

from rendezview.errors import RendezviewError
from rendezview.trajectory import (
    Correction,
    NoFit,
    Plan,
    PointCloud,
    Segment,
    Shape,
    correct,
    fit_segment,
    load_plan,
)
from rendezview.trajectory.relative_orbit import transition

CIRCULAR = """
[circular]
radius_m = 30.0
rate_rad_s = 0.005
start = [0.0, 2.0, 0.0]
towards = [0.0, 0.0, 1.0]
"""
ORBIT = """
[orbit]
mean_motion_rad_s = 0.0011
radial = [0.0, 0.0, 1.0]
along_track = [1.0, 0.0, 0.0]
"""


def plan_of(tmp_path, text: str) -> Plan:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    return load_plan(path)


def test_circle_starts_and_turns_as_told(tmp_path):
    plan = plan_of(tmp_path, CIRCULAR)
    assert plan.shape is Shape.CIRCULAR
    assert plan.turn_rad == 1.0
    places = plan.places([0.0, 0.5 * math.pi / 0.005])
    np.testing.assert_allclose(places, [[0, 30, 0], [0, 0, 30]], atol=1e-9)
    np.testing.assert_allclose(plan.velocity(0.0), [0, 0, 0.15], atol=1e-6)


def test_every_kind_of_path_is_read(tmp_path):
    spiral = plan_of(tmp_path, CIRCULAR.replace("circular", "spiral") + "radius_rate_m_s = -0.01\n")
    assert np.linalg.norm(spiral.places([100.0])[0]) == pytest.approx(29.0)
    vbar = plan_of(
        tmp_path,
        "[vbar]\naxis = [1.0, 0.0, 0.0]\ndistance_m = 50.0\nspeed_m_s = 0.1\n"
        "hop_ratio = 0.02\nhop_s = 100.0\n[segment]\ntime_s = 100.0\n",
    )
    np.testing.assert_allclose(vbar.places([50.0])[0], [45.0, 0.0, 0.9], atol=1e-9)
    assert vbar.segment_s == 100.0
    orbit = plan_of(
        tmp_path,
        "[orbit_path]\nposition_m = [0.0, 50.0, 0.0]\nvelocity_m_s = [0.01, 0.0, 0.0]\n" + ORBIT,
    )
    state = [0.0, 50.0, 0.0, 0.01, 0.0, 0.0]
    np.testing.assert_allclose(orbit.places([300.0])[0], (transition(0.0011, 300.0) @ state)[:3])
    points = "".join(
        f"[[way_points]]\ntime_s = {t}\nposition_m = [{40.0 - t / 10}, 0.0, 1.0]\n"
        for t in (0.0, 50.0, 100.0)
    )
    way = plan_of(tmp_path, points)
    np.testing.assert_allclose(way.places([25.0])[0], [37.5, 0.0, 1.0], atol=1e-9)
    assert way.out_of(101.0) == "the plan ends at 100 s"


def test_hills_frame_stands_as_told_and_turns_under_an_inertial_target(tmp_path):
    plan = plan_of(tmp_path, CIRCULAR + ORBIT)
    # Radial is the target's +Z, along the track its +X, so the normal is +Y.
    np.testing.assert_allclose(plan.path_from_target(50.0) @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(plan.path_from_target(50.0) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    inertial = plan_of(tmp_path, CIRCULAR + ORBIT + 'attitude = "inertial"\n')
    quarter_s = 0.5 * math.pi / 0.0011
    # A quarter of an orbit on, what stood outwards stands against the velocity.
    np.testing.assert_allclose(
        inertial.path_from_target(quarter_s) @ [0, 0, 1], [0, -1, 0], atol=1e-9
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "0 paths"),
        (CIRCULAR + "[vbar]\naxis=[1.0,0.0,0.0]\ndistance_m=9.0\nspeed_m_s=0.1\n", "2 paths"),
        (CIRCULAR.replace("[0.0, 0.0, 1.0]", "[0.0, -1.0, 0.0]"), "one line"),
        (CIRCULAR.replace("30.0", "-30.0"), "radius_m"),
        (CIRCULAR.replace("30.0", "nan"), "radius_m"),
        (CIRCULAR + "speed = 3\n", "speed"),
        (CIRCULAR + "[segment]\nturn_rad = 4.0\n", "turn_rad"),
        ("start_s = 5.0\nend_s = 1.0\n" + CIRCULAR, "ends"),
        ("[orbit_path]\nposition_m=[1.0,0.0,0.0]\nvelocity_m_s=[0.0,0.0,0.0]\n", "orbit"),
        ("[[way_points]]\ntime_s=1.0\nposition_m=[1.0,0.0,0.0]\n" * 2, "rise"),
        ("nonsense", "TOML"),
    ],
)
def test_a_wrong_plan_is_refused_in_words(tmp_path, text, words):
    with pytest.raises(RendezviewError, match=words):
        plan_of(tmp_path, text)


def free_flight(tmp_path) -> tuple[Plan, Segment, np.ndarray]:
    """A free orbit flown with a wrong first velocity."""
    plan = plan_of(
        tmp_path,
        "[orbit_path]\nposition_m = [0.0, 50.0, 0.0]\nvelocity_m_s = [0.01, 0.0, 0.0]\n" + ORBIT,
    )
    state = np.array([0.2, 50.0, 0.0, 0.012, -0.002, 0.001])
    truth = np.array([(transition(0.0011, t) @ state)[:3] for t in TIMES])
    cloud = refined(truth, np.random.default_rng(1), sigma_m=1e-4)
    segment = fit_segment(cloud, Shape.ORBIT, mean_motion_rad_s=0.0011)
    assert isinstance(segment, Segment)
    return plan, segment, state


@pytest.mark.requirement("RV-PATH-1")
def test_the_correction_flown_meets_the_plan_in_place_and_velocity(tmp_path):
    plan, segment, state = free_flight(tmp_path)
    given = correct(segment, plan, 200.0, 400.0)
    assert isinstance(given, Correction)
    now = transition(0.0011, 200.0) @ state
    np.testing.assert_allclose(given.error_m, now[:3] - plan.places([200.0])[0], atol=2e-3)
    now[3:] += given.delta_v_m_s
    then = transition(0.0011, 200.0) @ now
    np.testing.assert_allclose(then[:3], plan.places([400.0])[0], atol=3e-3)
    then[3:] += given.arrival_delta_v_m_s
    np.testing.assert_allclose(then[3:], plan.velocity(400.0), atol=5e-5)
    assert given.direction is not None
    assert given.direction @ given.delta_v_m_s == pytest.approx(given.size_m_s)


def test_a_plan_elsewhere_or_over_gets_a_reason(tmp_path):
    plan, segment, _ = free_flight(tmp_path)
    elsewhere = plan_of(tmp_path, CIRCULAR + ORBIT)
    for other, times, words in (
        (elsewhere, (200.0, 400.0), "does not fly it"),
        (plan, (200.0, 200.0), "no time"),
        (plan, (200.0, math.nan), "no time"),
        (plan, (200.0, 200.0 + math.pi / 0.0011), "half an orbit"),
        (plan_of(tmp_path, "end_s = 150.0\n" + CIRCULAR), (200.0, 400.0), "ends at 150"),
    ):
        found = correct(segment, other, *times)
        assert isinstance(found, NoFit)
        assert words in found.reason


def test_an_empty_cloud_has_no_segment_to_correct():
    assert not fit_segment(PointCloud.empty(), Shape.ORBIT)
