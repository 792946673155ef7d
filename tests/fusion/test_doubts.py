"""Doubts: what the level contains beside what is believed."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.fusion.scenes import SIGMA, World, along_axis

from rendezview.fusion import Fusion, FusionOptions
from rendezview.fusion.choice import _outlived, _own_share
from rendezview.fusion.hypothesis import Hypothesis, look
from rendezview.fusion.rivals import Kind, Rival
from rendezview.fusion.trust import LOCK_AFTER, Trust


def is_protected(world, fusion, time_s):
    """Whether the state is within its levels, or an alarm says that it may not be."""
    estimate = fusion.state_at(time_s)
    off, levels = world.error(estimate.pose, world.truth(time_s)), estimate.protection
    place, turn = np.linalg.norm(off[3:]), np.linalg.norm(off[:3])
    return levels.alarm or (place <= levels.position_m and turn <= levels.attitude_rad)


def test_a_ranger_that_was_locked_out_is_doubted_when_it_returns_where_little_tells():
    """0.3 m off: 6 σ beside a good camera, and 1 σ of a bad one, which cannot turn it away."""
    returned = 0
    for seed in range(3):
        world = World(seed, along_axis(lambda _: 30.0))
        fusion = Fusion()
        for k in range(200):
            time_s, sharp = 0.5 * k, k < 60
            fusion.add(world.pose(time_s, sigma=SIGMA if sharp else 6.0 * SIGMA))
            told = world.range(time_s)
            told = replace(told, range_m=told.range_m + (0.3 if k >= 30 else 0.0))
            returned += fusion.add(told).accepted and not sharp
            assert is_protected(world, fusion, time_s), (seed, time_s)
    assert returned > 50  # or nothing is tested


def test_a_reading_in_glare_between_two_silences_does_not_end_the_protection():
    """Five σ off, and believed: the forecast after a silence is wide. The level holds both."""
    believed = 0
    for seed in range(25):
        world, fusion = World(seed), Fusion()
        for k in range(40):
            fusion.add(world.pose(0.5 * k))
        glare = 5.0 * SIGMA * world.rng.standard_normal(6)
        believed += fusion.add(world.pose(23.5, glare)).accepted
        for k in range(8):
            assert is_protected(world, fusion, 23.5 + 0.5 * k), (seed, k)
    assert believed > 5  # or nothing is tested


def test_a_ranger_that_lied_for_long_is_doubted_for_as_long():
    """0.3 m off; a camera of 0.15 m whose errors last makes it look right now and then."""
    outside = total = 0
    for seed in range(4):
        world, fusion = World(seed, along_axis(lambda _: 45.0)), Fusion()
        lasting, keep = world.rng.standard_normal(6), math.exp(-2.0 / 25.0)
        for k in range(600):
            time_s = 0.5 * k
            if k % 2 == 0:
                told = world.range(time_s)
                lie_m = 0.3 if k >= 60 else 0.0
                fusion.add(replace(told, range_m=told.range_m + lie_m))
            if k % 4 == 0:
                sigma = SIGMA * np.array([1.0, 1.0, 1.0, 1.0, 1.0, 3.0])
                sigma = sigma if k >= 100 else 0.2 * sigma
                fresh, white = world.rng.standard_normal((2, 6))
                lasting = keep * lasting + math.sqrt(1.0 - keep**2) * fresh
                error = sigma * (math.sqrt(0.65) * lasting + math.sqrt(0.35) * white)
                seen = world.pose(time_s, error, sigma=1e-9 * SIGMA)
                fusion.add(replace(seen, covariance=np.diag(sigma**2)))
            if k >= 12:
                outside += not is_protected(world, fusion, time_s)
                total += 1
    assert outside <= 0.05 * total  # 19 % without memory of the fault


def test_what_locked_a_sensor_out_remains_possible_when_a_manoeuvre_is_likelier():
    """A winner that believes the sensor leaves its opponent as a doubt, less likely by its lead."""
    world, fusion = World(0), Fusion()
    for k in range(20):
        fusion.add(world.pose(0.5 * k))
        fusion.add(world.range(0.5 * k))
    main = fusion._newest.main
    assert main is not None
    ill = main.trusts["laser"]._replace(rejected=9)
    loser = main._replace(trusts={**main.trusts, "laser": ill})
    ratios = {"camera": 8.0, "laser": 2.0}
    winner = Rival(Kind.MANOEUVRE, main, -3.0, 10.0, ratios=ratios)
    earlier = Rival(Kind.DOUBT, main, -1.0, 5.0, doubts="camera")
    kept = {rival.doubts: rival for rival in _outlived(winner, loser, (winner, earlier), 10.0)}
    assert kept["laser"].hypothesis is loser
    assert kept["laser"].score == pytest.approx(3.0 - 8.0)  # the laser fits both
    assert kept["camera"].score == pytest.approx(-1.0 + 3.0 - 2.0)
    assert _outlived(winner._replace(kind=Kind.START), loser, (earlier,), 10.0) == ()


def test_a_doubt_that_wins_is_no_rival_of_itself_and_an_unknown_sensor_stays_in_doubt():
    locked = Trust("laser")._replace(rejected=LOCK_AFTER)
    loser = Hypothesis(None, {"laser": locked}, 1, 0.0, 0.0)
    winner = Rival(Kind.MANOEUVRE, loser._replace(trusts={}), 1.0, 0.0)
    (kept,) = _outlived(winner, loser, (), 1.0)
    assert (kept.kind, kept.doubts, kept.hypothesis) == (Kind.DOUBT, "laser", loser)
    trusting = loser._replace(trusts={"laser": Trust("laser")})
    assert _outlived(kept._replace(fitting=3), trusting, (kept,), 1.0) == ()


def test_readings_beside_one_error_of_the_state_say_together_what_one_does():
    """How much a reading says anew, beside a sharp state and beside a wide one."""
    world, fusion = World(0), Fusion()
    for k in range(10):
        fusion.add(world.pose(0.5 * k))
    told = world.range(4.5)
    main = fusion._newest.main
    found = []
    for sigma_m in (10.0, 0.001):
        reading = replace(told, sigma_m=sigma_m)
        seen = look(main.state, reading, FusionOptions())
        found.append(_own_share(Rival(Kind.DOUBT, main, 0.0, 4.5), seen))
    assert found[0] == pytest.approx(1.0, abs=1e-3)
    assert found[1] < 0.01


def test_what_else_may_be_true_is_told_with_its_probability():
    world, fusion = World(0), Fusion()
    for k in range(20):
        fusion.add(world.pose(0.5 * k))
    assert Kind.START not in fusion.rivals
    fusion.add(world.pose(10.0, 40.0 * SIGMA))
    assert 0.0 < fusion.rivals[Kind.START] < 0.1
