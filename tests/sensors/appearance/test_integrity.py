"""Protection levels of poses: what widens them, what alarms, and what the tracker passes on."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.estimation.protection import Overbound
from rendezview.fusion.logs import LogContext, read_record
from rendezview.geometry import so3
from rendezview.geometry.pose import Pose
from rendezview.io.results import json_line
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.integrity.evidence import Evidence, Other, Second
from rendezview.sensors.appearance.integrity.model import (
    FRAME_FEATURES,
    PACKAGED,
    SPREAD_FEATURES,
    TRACK_FEATURES,
    IntegrityModel,
    SecondEstimator,
    Spread,
    frame_features,
    track_features,
)
from rendezview.sensors.appearance.integrity.monitor import IntegrityMonitor, IntegrityOptions
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.outline.reading import OutlineReading
from rendezview.sensors.observation import Status
from rendezview.sensors.protection import Levels, Protection

NAMES = FRAME_FEATURES + TRACK_FEATURES
SIGMA_RAD, SIGMA_M = 1e-3, 0.01
AGREES, DISAGREES = Second(0.01, 0.9), Second(2.0, 0.9)


def model(**weights: float) -> IntegrityModel:
    """Gaussian tails, and log odds of some features; −20 (never wrong) without any."""
    given = {"constant": -20.0} | weights
    return IntegrityModel(
        attitude=Overbound(1.0, 1e6),
        position=Overbound(1.0, 1e6),
        attitude_spread=Spread.none(),
        position_spread=Spread.none(),
        wrong=np.array([given.get(name, 0.0) for name in NAMES]),
        at_rival=0.4,
        smoothing=0.5,
        allowance=0.5,
        most=4.0,
        limit=12.0,
    )


def evidence(time_s: float = 0.0, **changes: Any) -> Evidence:
    plain = Evidence(
        time_s=time_s,
        range_m=20.0,
        covariance=np.diag([SIGMA_RAD**2] * 3 + [SIGMA_M**2] * 3),
        confidence=0.999,
        prior=True,
        followed=True,
        sketched=False,
        outline=0.9,
        inner=0.8,
        visible=1.0,
        residual_px=0.15,
        light=0.9,
        overshoot=0.0,
        dark=True,
        shading=np.nan,
        votes=np.nan,
        trees=3.0,
        margin=1.0,
        rival_rad=np.nan,
        rival_m=np.nan,
        innovation=None if time_s == 0.0 else np.zeros(6),
    )
    return dataclasses.replace(plain, **changes)


@pytest.mark.requirement("RV-INT-1")
def test_without_doubt_the_level_is_the_tail_of_the_covariance():
    found = IntegrityMonitor(IntegrityOptions(risk=1e-3), model()).judge(evidence())
    assert found.attitude_rad == pytest.approx(4.0331 * SIGMA_RAD, rel=1e-3)  # χ, 3 degrees
    assert found.position_m == pytest.approx(4.0331 * SIGMA_M, rel=1e-3)
    assert found.axes == pytest.approx([3.2905 * SIGMA_RAD] * 3 + [3.2905 * SIGMA_M] * 3, rel=1e-3)
    assert not found.alarm


@pytest.mark.requirement("RV-INT-1")
def test_a_smaller_risk_gives_larger_levels():
    levels = [
        IntegrityMonitor(IntegrityOptions(risk=risk), IntegrityModel.packaged())
        .judge(evidence())
        .attitude_rad
        for risk in (1e-2, 1e-3, 1e-4, 1e-6)
    ]
    assert levels == sorted(levels)
    assert len(set(levels)) >= 2


@pytest.mark.requirement("RV-INT-2")
def test_a_rival_that_is_not_excluded_is_inside_the_level():
    doubtful = model(constant=0.0, no_prior=-8.0)
    other = evidence(prior=False, rival_rad=0.7, rival_m=1.5)
    found = IntegrityMonitor(IntegrityOptions(risk=1e-3), doubtful).judge(other)
    # Half of 3.4e-4 would be anything else: less than the risk, but the rival is not.
    assert found.wrong == pytest.approx(1.0 / (1.0 + math.exp(8.0)))
    assert found.attitude_rad < 0.7
    found = IntegrityMonitor(IntegrityOptions(risk=1.2e-3), model(constant=-6.2)).judge(other)
    assert found.wrong == pytest.approx(2.03e-3, rel=1e-2)
    assert found.attitude_rad == pytest.approx(math.pi)  # 60 % of it is any attitude
    certain = dataclasses.replace(model(constant=-6.2), at_rival=0.9)
    found = IntegrityMonitor(IntegrityOptions(risk=1.2e-3), certain).judge(other)
    assert found.attitude_rad == pytest.approx(0.7)
    assert found.position_m == pytest.approx(1.5)
    assert np.all(found.axes[:3] == pytest.approx(0.7))


@pytest.mark.requirement("RV-INT-2")
def test_look_alikes_that_a_frame_leaves_possible_are_inside_the_level_of_the_whole_track():
    monitor = IntegrityMonitor(IntegrityOptions(risk=1e-3), model())
    beside = (Other(2.0, 3.0, 0.02), Other(1.0, 0.5, 4e-4))
    first = monitor.judge(evidence(others=beside))
    assert first.attitude_rad == pytest.approx(2.0)
    assert first.position_m == pytest.approx(3.0)
    assert first.wrong == pytest.approx(0.0204)
    # The next frames are tracked: they look nowhere else.
    assert monitor.judge(evidence(1.0)).attitude_rad == pytest.approx(2.0)
    # A jump begins another track.
    jump = evidence(2.0, innovation=np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert monitor.judge(jump).attitude_rad < 0.01


def test_a_second_estimator_that_agrees_rules_look_alikes_out_and_one_that_does_not_supports_them():
    options = IntegrityOptions(risk=1e-3, second_every=1)
    for second, odds in ((AGREES, 1.0 / 9.0), (DISAGREES, 9.0)):
        monitor = IntegrityMonitor(options, model())
        monitor.judge(evidence(others=(Other(2.0, 3.0, 0.02),)))
        found = monitor.judge(evidence(1.0), lambda second=second: second)
        ratio = odds * 0.02 / 0.98
        assert found.wrong == pytest.approx(ratio / (1.0 + ratio))


@pytest.mark.requirement("RV-INT-2")
def test_a_pose_that_may_be_anything_has_no_level_and_an_alarm():
    found = IntegrityMonitor(IntegrityOptions(), model(constant=-3.0)).judge(evidence())
    assert found.attitude_rad == math.pi
    assert found.position_m == math.inf
    assert found.alarms == ("attitude", "position")
    assert json.loads(json_line(found.record()))["position_m"] is None


@pytest.mark.requirement("RV-INT-3")
def test_a_level_above_the_users_limit_is_an_alarm():
    options = IntegrityOptions(alarm_attitude_rad=3.0 * SIGMA_RAD, alarm_position_m=1.0)
    assert IntegrityMonitor(options, model()).judge(evidence()).alarms == ("attitude",)
    options = IntegrityOptions(alarm_attitude_rad=1.0, alarm_position_m=2.0 * SIGMA_M)
    assert IntegrityMonitor(options, model()).judge(evidence()).alarms == ("position",)


@pytest.mark.requirement("RV-INT-3")
def test_the_second_witness_is_asked_in_doubt_only_and_a_disagreement_is_an_alarm():
    asked: list[Second] = []

    def answers(second: Second):
        def ask() -> Second:
            asked.append(second)
            return second

        return ask

    calm = IntegrityMonitor(IntegrityOptions(), model())
    assert calm.judge(evidence(), answers(DISAGREES)).alarms == ()
    assert asked == []
    doubtful = model(constant=-5.0, no_second=0.0, second_agrees=-10.0)
    agreed = IntegrityMonitor(IntegrityOptions(), doubtful).judge(evidence(), answers(AGREES))
    assert agreed.alarms == ()
    assert agreed.wrong < 1e-5
    other = IntegrityMonitor(IntegrityOptions(), doubtful).judge(evidence(), answers(DISAGREES))
    assert "attitude" in other.alarms
    sharp = model(no_second=15.0)  # doubt vanishes with any second look
    other = IntegrityMonitor(IntegrityOptions(), sharp).judge(evidence(), answers(DISAGREES))
    assert other.alarms == ("witnesses",)


def test_the_second_witness_is_asked_every_tenth_frame_at_most():
    times: list[float] = []
    monitor = IntegrityMonitor(IntegrityOptions(second_every=10), model(constant=-3.0))
    for k in range(25):
        monitor.judge(evidence(float(k)), lambda k=k: times.append(k))
    assert times == [0, 10, 20]


def test_a_sketch_is_no_second_witness_of_its_own_pose():
    asked: list[int] = []
    monitor = IntegrityMonitor(IntegrityOptions(), model(constant=-3.0))
    for k in range(3):
        monitor.judge(evidence(float(k), sketched=k < 2), lambda k=k: asked.append(k))
    assert asked == [2]


def test_a_disagreement_is_asked_about_again():
    monitor = IntegrityMonitor(IntegrityOptions(second_every=5), model(no_second=15.0))
    answers = [DISAGREES, AGREES]
    alarms = [monitor.judge(evidence(float(k)), lambda: answers.pop(0)).alarms for k in range(8)]
    assert alarms == [("witnesses",)] * 5 + [()] * 3
    assert not answers


def test_each_agreement_counts_up_to_a_few_and_disagreements_stand_against_them():
    found = SecondEstimator()
    for _ in range(6):
        found = found.after(AGREES)
    young, once, again, against, none = track_features(30, found)
    assert (once, again, against, none) == (1.0, 3.0, 0.0, 0.0)
    assert young == pytest.approx(1.0 / 21.0)
    found = found.after(None).after(DISAGREES)
    assert track_features(30, found)[3:] == pytest.approx([0.9, 0.0])
    assert found.contradicts(0.1)
    assert not found.contradicts(3.0)  # the level reaches it
    assert not found.after(Second(2.0, 0.4)).contradicts(0.1)  # unsure
    assert not found.after(AGREES).contradicts(0.1)
    assert track_features(0, SecondEstimator().after(None))[1:] == pytest.approx(
        [0.0, 0.0, 0.0, 1.0]
    )


def test_a_level_follows_what_the_frame_shows_of_its_covariance():
    weights = np.zeros(len(SPREAD_FEATURES))
    weights[FRAME_FEATURES.index("dim")] = 2.0  # evidence: 0.1 of it
    weights[-1] = -0.5  # of log σ
    spread = Spread(weights, -10.0, 10.0)
    plain = IntegrityMonitor(IntegrityOptions(), model()).judge(evidence())
    told = dataclasses.replace(model(), attitude_spread=spread)
    found = IntegrityMonitor(IntegrityOptions(), told).judge(evidence())
    factor = math.exp(0.2) / math.sqrt(math.sqrt(3.0) * SIGMA_RAD)
    assert found.attitude_rad == pytest.approx(factor * plain.attitude_rad)
    assert found.position_m == plain.position_m
    told = dataclasses.replace(model(), position_spread=dataclasses.replace(spread, most=0.7))
    found = IntegrityMonitor(IntegrityOptions(), told).judge(evidence())
    assert found.position_m == pytest.approx(math.exp(0.7) * plain.position_m)
    assert Spread.of_record(spread.record(), "spread").record() == spread.record()
    with pytest.raises(ValueError, match="log_sigma"):
        Spread.of_record({"weights": {}, "least": 0.0, "most": 0.0}, "spread")


def test_confidence_grows_along_a_track_and_a_jump_begins_another():
    monitor = IntegrityMonitor(IntegrityOptions(), model(constant=-8.0, young=4.0))
    odds = [monitor.judge(evidence(float(k))).wrong for k in range(10)]
    assert odds == sorted(odds, reverse=True)
    away = evidence(10.0, innovation=np.array([0.5, 0, 0, 0, 0, 0]))
    assert monitor.judge(away).wrong == pytest.approx(odds[0])


@pytest.mark.requirement("RV-INT-4")
def test_a_drift_of_the_motion_is_an_alarm_and_an_allowed_acceleration_is_not():
    options = IntegrityOptions(turn_rad_s2=0.0, move_m_s2=0.0)
    for offset, alarms in ((0.0, ()), (8.0, ("drift",))):
        monitor = IntegrityMonitor(options, model())
        innovation = np.array([0, 0, 0, 0, 0, offset * SIGMA_M])
        for k in range(20):
            # Of a new pose and of 2 x₁ − x₀ the variance is six times that of one.
            found = monitor.judge(evidence(float(k), innovation=innovation if k else None))
        assert found.alarms == alarms
    allowed = IntegrityMonitor(IntegrityOptions(move_m_s2=8.0 * SIGMA_M), model())
    for k in range(20):
        found = allowed.judge(evidence(float(k), innovation=innovation if k else None))
    assert found.alarms == ()


def test_evidence_survives_its_record():
    original = evidence(3.0, innovation=np.arange(6.0), others=(Other(1.0, 2.0, 0.01),))
    again = Evidence.of_record(json.loads(json_line(original.record())))
    for field in dataclasses.fields(Evidence):
        np.testing.assert_equal(getattr(again, field.name), getattr(original, field.name))


def test_frame_features_have_a_name_each_and_are_finite():
    features = frame_features(evidence(confidence=1.0, residual_px=0.0, shading=0.5))
    assert len(features) == len(FRAME_FEATURES)
    assert np.all(np.isfinite(features))
    named = dict(zip(FRAME_FEATURES, features, strict=True))
    assert named["doubt"] == -8.0
    assert named["unshaded"] == pytest.approx(0.5)
    assert named["rival"] == 0.0


def test_the_packaged_numbers_say_what_they_were_fitted_to_and_survive():
    record = json.loads(PACKAGED.read_text(encoding="utf-8"))
    assert record["provenance"]["experiment"] == "integrity-fit"
    assert IntegrityModel.of_record(record).record() == record
    wrong = dict(record["wrong"])
    wrong.pop("young")
    with pytest.raises(ValueError, match="young"):
        IntegrityModel.of_record(record | {"wrong": wrong})


@pytest.mark.parametrize("options", [{"risk": 0.5}, {"risk": 0.0}, {"alarm_attitude_rad": -1.0}])
def test_options_that_cannot_be_are_refused(options):
    with pytest.raises(RendezviewError):
        IntegrityOptions(**options)


def test_an_observation_without_a_refined_pose_is_left_as_it_is():
    monitor = IntegrityMonitor(IntegrityOptions(), model())
    seen = AppearanceObservation(Status.LOST, "nothing")
    assert monitor.protected(seen, 0.0, None, np.zeros(3)) is seen
    assert "protection" not in seen.record()


def test_evidence_is_that_of_the_observation_and_its_prediction():
    turn = np.array([0.01, -0.02, 0.03])
    centre_m = np.array([0.0, 0.0, 1.0])
    predicted = Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    pose = Pose(so3.exp(turn), np.array([0.1, 0.0, 10.0]))
    away = np.add(pose.translation_m, [0.3, 0.0, 0.4])
    rival = Pose(so3.exp(np.array([0.0, 0.0, 1.0])) @ pose.rotation, away)
    best = Hypothesis(pose, np.eye(6), 0.9, 0.8, 1.0, 0.2, 0.7, overshoot=0.05)
    other = Hypothesis(rival, np.eye(6), 0.5, 0.4, 1.0, 0.6, 0.7)
    found = Found(best, 0.2, True, True, other, single=True)
    seen = AppearanceObservation(
        Status.OK,
        pose=pose,
        covariance=np.eye(6),
        found=found,
        outline=OutlineReading(weights=np.array([1.0, 0.5])),
    )
    made = Evidence.of(seen, 2.0, predicted, centre_m)
    assert made is not None
    assert made.innovation == pytest.approx([*turn, 0.1, 0.0, 0.0])
    assert made.range_m == pytest.approx(float(np.linalg.norm(pose.apply(centre_m))))
    assert made.rival_rad == pytest.approx(1.0)
    assert made.rival_m == pytest.approx(0.5)
    assert (made.outline, made.margin, made.trees, made.followed) == (0.9, 0.2, 1.5, True)
    assert np.isnan(made.shading)
    assert made.others == ()
    weighed = tuple(Hypothesis(p, probability=w) for p, w in ((pose, 0.97), (rival, 0.03)))
    beside = dataclasses.replace(seen, found=dataclasses.replace(found, weighed=weighed))
    made = Evidence.of(beside, 2.0, predicted, centre_m)
    assert made is not None
    assert made.others[0] == pytest.approx((1.0, 0.5, 0.03))
    alone = Evidence.of(dataclasses.replace(seen, time_s=1.0), 2.0, None, centre_m)
    assert alone is not None
    assert alone.innovation is None


def test_a_pose_with_an_alarm_is_no_measurement():
    plain = Protection(1e-3, 0.01, 0.1, np.zeros(6), 0.0, 0.0)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    seen = AppearanceObservation(Status.OK, time_s=0.0, pose=pose, covariance=np.eye(6))
    assert dataclasses.replace(seen, protection=plain).measurement("camera") is not None
    alarmed = dataclasses.replace(seen, protection=dataclasses.replace(plain, alarms=("drift",)))
    assert alarmed.measurement("camera") is None
    for one in (dataclasses.replace(seen, protection=plain), alarmed):
        line = json.loads(json_line(one.record()))
        taken = read_record(line, "pose", "camera", LogContext(), "log")
        assert (taken is None) == (one is alarmed)


def test_levels_of_a_run_are_summed_up_in_a_line():
    levels = Levels()
    assert str(levels) == "protection levels: no pose has one"
    levels.add(None)
    levels.add(Protection(1e-3, math.radians(2.0), 0.1, np.zeros(6), 0.0, 0.0))
    levels.add(Protection(1e-3, 3.0, 9.0, np.zeros(6), 0.1, 0.0, ("attitude", "drift")))
    assert str(levels) == (
        "protection levels: 1 of 2 poses without an alarm, 2° and 0.1 m median; "
        "alarms: attitude 1, drift 1"
    )
