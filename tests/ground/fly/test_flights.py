"""Whole flights: contact, faults, replays, campaigns, and a stranger's controller."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.ground.fly.conftest import short_plan

from rendezview_ground.fly.campaign import agreement, campaign, fly_once, record
from rendezview_ground.fly.dynamics import OrbitDynamics
from rendezview_ground.fly.faults import Fault, fault_of_run
from rendezview_ground.fly.guidance import Guidance
from rendezview_ground.fly.loop import FusedEstimator, Loop
from rendezview_ground.fly.options import FlyPlan
from rendezview_ground.fly.report import replayed, write_campaign_page, write_flight_page
from rendezview_ground.fly.sensors import ModelledSensors
from rendezview_ground.learn.jobs.cores import Cores


def test_a_faultless_flight_ends_in_contact_inside_the_envelope(setup, tmp_path):
    flight = fly_once(setup, 0)
    assert (flight.end, flight.outside, flight.beyond) == ("contact", None, 0)
    assert flight.moments[-1].true.range_m < 0.1
    page = write_flight_page(tmp_path, "client", setup, flight, 0, None).read_text()
    assert "inside" in page
    assert "<script" not in page
    assert "http" not in page.replace("http-equiv", "")


def test_no_retreat_begins_where_the_chaser_can_no_longer_stop(setup):
    """By the whole plan, with the seed in which a late retreat touched at 7 mm/s."""
    flight = fly_once(replace(setup, plan=FlyPlan()), 1062)
    assert (flight.end, flight.outside) == ("contact", None)


def test_a_dead_camera_leads_to_a_hold_and_no_contact(setup):
    flight = fly_once(setup, 0, Fault("camera", 12.0, 1e9, 0.0))
    assert flight.contact is None
    assert flight.end in ("held", "aborted")
    assert any(
        moment.mode in ("hold", "retreat") for moment in flight.moments if moment.time_s > 12
    )
    assert min(moment.true.range_m for moment in flight.moments) > 0.2


def test_a_camera_that_comes_back_leads_to_contact_after_a_hold(setup):
    flight = fly_once(setup, 0, Fault("camera", 12.0, 42.0, 0.0))
    modes = [moment.mode for moment in flight.moments if moment.time_s > 12.0]
    assert flight.end == "contact"
    assert modes.index("approach", next(k for k, m in enumerate(modes) if m != "approach")) > 0


def flown(setup, controller, sensors=ModelledSensors):
    """A flight by a controller, with modelled sensors."""
    plan, port = setup.plan, setup.port
    return Loop(sensors(setup, 0), FusedEstimator(), controller, OrbitDynamics(plan, port, 0)).run()


def test_a_sensor_is_given_the_forecast_of_its_own_time(setup):
    """By the state of the step before, the ring seemed 4 cm off near contact, and was refused."""
    apart = []

    class Forecast(ModelledSensors):
        def read(self, truth, known):
            forecast = None if known is None else known.forecast(truth.time_s)
            if forecast is not None and forecast.pose is not None:
                assert forecast.time_s == truth.time_s
                true, poses = truth.pose.translation_m, (known.estimate.pose, forecast.pose)
                apart.append([np.linalg.norm(pose.translation_m - true) for pose in poses])
            return super().read(truth, known)

    flown(setup, Guidance(setup.plan, setup.port), Forecast)
    before, ahead = np.median(apart[len(apart) // 2 :], axis=0)
    assert before > 0.03
    assert ahead < 0.5 * before


def test_a_seed_is_the_same_flight_again(setup):
    one, two = (record(fly_once(setup, 7), 7, None) for _ in range(2))
    assert json.dumps(one) == json.dumps(two)
    assert record(fly_once(setup, 8), 8, None) != one


def test_a_campaign_goes_on_after_a_kill_with_the_same_bytes(setup, tmp_path):
    kinds, whole, cut = ("laser", "ring"), tmp_path / "whole.jsonl", tmp_path / "cut.jsonl"
    lines = campaign(setup, whole, 6, 0, kinds, 3, Cores(1))
    assert [line["fault"] for line in lines] == ["laser", None, None, "ring", None, None]

    class Killed(Exception):
        pass

    def kill(_: str, done: int, __: int) -> None:
        if done == 1:
            raise Killed

    with pytest.raises(Killed):
        campaign(setup, cut, 6, 0, kinds, 3, Cores(1), kill)
    assert not cut.exists()
    seen: list[int] = []
    campaign(setup, cut, 6, 0, kinds, 3, Cores(1), lambda _, done, __: seen.append(done))
    assert seen[0] >= 1  # what was finished is not flown again
    assert cut.read_bytes() == whole.read_bytes()
    again = fly_once(setup, 3, Fault.drawn("ring", 3))
    assert record(again, 3, Fault.drawn("ring", 3)) == lines[3]
    page = write_campaign_page(tmp_path, "client", setup, lines).read_text()
    assert "--seed 3 --faults ring" in page


def test_an_edge_that_is_taken_for_the_ring_does_not_keep_the_chaser_from_contact(setup):
    """Where it is only turned away, its sensor contradicts the state until the end: an alarm."""
    fault = Fault.drawn("ring", 3)
    assert record(fly_once(setup, 3, fault), 3, fault)["end"] == "contact"


def test_contacts_of_one_distribution_agree_and_of_another_do_not(setup, tmp_path):
    rng = np.random.default_rng(3)

    def contacts(closing_m_s):
        keys = ("lateral_m", "tilt_rad", "roll_rad", "lateral_m_s", "across_rad_s", "about_rad_s")
        return [
            {"contact": {k: 0.01 * rng.random() for k in keys}
             | {"closing_m_s": closing_m_s + 0.002 * rng.standard_normal()},
             "fault": None, "end": "contact", "touch_m": [0.0, 0.0], "beyond": 0, "steps": 480,
             "time_s": 240.0, "seed": seed}
            for seed in range(30)
        ]  # fmt: skip

    one, same, other = contacts(0.075), contacts(0.075), contacts(0.08)
    assert all(p > 0.05 for *_, p in agreement(one, same))
    assert {key for key, *_, p in agreement(one, other) if p < 0.05} == {"closing_m_s"}
    lost = [{"contact": None, "fault": None}]
    assert agreement(one, lost) == []
    page = write_campaign_page(tmp_path, "client", setup, one, other).read_text()
    assert "Kolmogorov" in page
    assert "Kolmogorov" not in write_campaign_page(tmp_path, "client", setup, one).read_text()


def test_the_worst_flights_of_each_end_are_linked(setup, tmp_path):
    touch = {"tilt_rad": 0.0, "roll_rad": 0.0, "closing_m_s": 0.075, "lateral_m_s": 0.0,
             "across_rad_s": 0.0, "about_rad_s": 0.0}  # fmt: skip
    line = {"fault": None, "time_s": 240.0, "beyond": 0, "steps": 480, "end": "contact"}
    lines = [
        line | {"seed": k, "touch_m": [0.0, 0.0], "contact": touch | {"lateral_m": 0.01 * k}}
        for k in range(5)
    ]
    lost = line | {"seed": 9, "end": "aborted", "contact": None, "fault": "laser"}
    lines.append(lost)
    kept = [one["seed"] for one in replayed(lines, setup)]
    assert sorted(kept) == [3, 4, 9]
    page = write_campaign_page(tmp_path, "client", setup, lines).read_text()
    assert [f'href="seed-{k}/flight.html"' in page for k in (2, 3, 4, 9)] == [False, *[True] * 3]


def test_one_run_in_ten_has_a_fault_each_kind_in_turn():
    kinds = ("camera", "glare")
    drawn = [fault_of_run(kinds, 10, seed) for seed in range(40)]
    assert [k for k in drawn if k] == ["camera", "glare", "camera", "glare"]
    assert drawn[1] is None


def strangers_flight(setup):
    """A stranger's controller in the loop: the README's example."""
    from rendezview_ground.fly.dynamics import Command
    from rendezview_ground.fly.port import Relative

    class ProportionalDerivative:
        """Straight in at 7 cm/s, without hold points."""

        def __init__(self, port) -> None:
            self.port = port

        def command(self, known):
            estimate = known.estimate
            if estimate.pose is None or estimate.rates is None:
                return Command(np.zeros(3), np.zeros(3))
            at = Relative.of(self.port, estimate.pose, estimate.rates, known.turning)
            off = at.mass_m - self.port.centre_m
            aside = off - (off @ self.port.axis) * self.port.axis
            wanted = -0.07 * self.port.axis - 0.1 * aside
            push = 0.5 * (wanted - at.mass_speed_m_s)
            rate = estimate.rates[:3] + 0.2 * at.turn
            return Command(estimate.pose.rotation @ push, rate)

    return flown(setup, ProportionalDerivative(setup.port))


def test_a_strangers_controller_takes_a_place_in_the_loop(setup):
    flight = strangers_flight(setup)
    assert flight.end == "contact"
    assert flight.contact.closing_m_s == pytest.approx(0.07, abs=0.01)


def test_a_strangers_estimator_without_a_state_never_moves_the_chaser_in(setup):
    from rendezview.fusion import Fusion
    from rendezview_ground.fly.guidance import Known

    class Blind:
        def update(self, time_s, readings):
            return Known(time_s, Fusion().state_at(time_s), np.zeros(3))

    plan = short_plan(longest_s=40.0)
    short = replace(setup, plan=plan)
    blind = replace(short, port=replace(setup.port, ring=None), patterns=())
    sensors = ModelledSensors(blind, 0)
    dynamics = OrbitDynamics(plan, setup.port, 0)
    flight = Loop(sensors, Blind(), Guidance(plan, short.port), dynamics).run()
    assert flight.end == "held"
    assert flight.moments[-1].spent_m_s == 0.0


def operated_flight(setup, orders: dict[float, str]):
    """A flight whose operator orders something at times."""

    class Operated(Guidance):
        def command(self, known):
            if known.time_s in orders:
                self.order(orders[known.time_s])
            return super().command(known)

    return flown(setup, Operated(setup.plan, setup.port))


def test_an_ordered_hold_lasts_until_the_order_to_go_on(setup):
    plan = short_plan(longest_s=250.0)
    flight = operated_flight(replace(setup, plan=plan), {12.0: "hold", 100.0: "go_on"})
    held = [m for m in flight.moments if 15.0 <= m.time_s < 100.0]
    assert {m.mode for m in held} == {"hold"}  # longer than the patience in a doubt
    assert {m.reason for m in held} == {"hold ordered"}
    assert flight.end == "contact"


def test_an_ordered_retreat_ends_at_the_hold_point_behind_and_costs_no_attempt(setup):
    plan = short_plan(longest_s=250.0)
    orders = {20.0: "retreat", 60.0: "retreat", 61.0: "retreat", 62.0: "retreat", 90.0: "go_on"}
    flight = operated_flight(replace(setup, plan=plan), orders)
    modes = [m.mode for m in flight.moments]
    assert "retreat" in modes
    waits = [m for m in flight.moments if 75.0 <= m.time_s < 90.0]
    assert {m.reason for m in waits} == {"retreat ordered"}
    assert all(m.true.range_m == pytest.approx(2.0, abs=0.3) for m in waits)
    assert flight.end == "contact"
