"""``rendezview track --plan`` and what ``show`` makes of its log."""

from pathlib import Path

import numpy as np
import pytest
from oem import OrbitEphemerisMessage

from rendezview.cli.guide import Guide, chaser_attitudes
from rendezview.cli.track import track
from rendezview.errors import RendezviewError
from rendezview.io.ccsds import epoch_of, orbit_message, parse_epoch
from rendezview.io.results import JsonLinesWriter
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.appearance.outline.reading import OutlineReading
from rendezview.sensors.observation import Status
from rendezview.trajectory import PathFollower, Shape, load_plan
from rendezview_ground.evaluate.show_command import show
from rendezview_ground.simulate.trajectories import looking_at

PLAN = """
[circular]
radius_m = 30.0
rate_rad_s = 0.05
start = [1.0, 0.0, 0.0]
towards = [0.0, 1.0, 0.0]
"""
COVARIANCE = np.diag([1e-7] * 3 + [1e-5] * 3)


def observation(time_s: float) -> AppearanceObservation:
    """Of a camera on a circle a metre too wide."""
    angle = 0.05 * time_s
    place = 31.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    pose = looking_at(place, np.zeros(3), [0.0, 0.0, 1.0])
    nodes = place + np.array([[1.0, 0.5, 2.0], [-1.0, -0.5, -2.0]])
    return AppearanceObservation(
        Status.OK,
        pose=pose,
        covariance=COVARIANCE,
        outline=OutlineReading(weights=np.ones(2), points_m=nodes),
    )


def seen_at(time_s: float) -> tuple:
    """What a guide takes of it."""
    seen = observation(time_s)
    return time_s, seen.pose, seen.covariance, seen.cloud


def test_plan_to_words_messages_and_pictures(tmp_path: Path):
    (tmp_path / "plan.toml").write_text(PLAN)
    guide = Guide(PathFollower(np.zeros(3), plan=load_plan(tmp_path / "plan.toml")))
    spoken = []
    with JsonLinesWriter(tmp_path / "log.jsonl") as log:
        for k in range(45):
            told, words = guide.update(*seen_at(float(k)))
            if words:
                spoken.append(words)
            seen = observation(float(k))
            frame = {"im_id": k, "time_s": float(k), "pose": seen.pose, "on_nodes": [1, 2]}
            log.write(frame | {"points_m": seen.points_m, "trajectory": told})
    assert len(spoken) == 2
    assert "1.000 m off the plan" in spoken[0]
    assert "Δv" in spoken[0]
    assert "spin 2.86" in spoken[0]
    guide.finish(tmp_path / "path.oem", tmp_path / "turn.aem", parse_epoch("2020-01-01"), "sat")
    states = OrbitEphemerisMessage.open(tmp_path / "path.oem").states
    np.testing.assert_allclose(np.linalg.norm(states[-1].position), 0.031, rtol=1e-4)
    assert "OBJECT_NAME = SAT" in (tmp_path / "turn.aem").read_text()
    show(tmp_path / "log.jsonl", tmp_path / "pictures")
    assert {p.name for p in (tmp_path / "pictures").iterdir()} == {
        "track.png", "curves.png", "cloud.png", "path.png", "rates.png",
    }  # fmt: skip


def test_wrong_options_are_said_in_words(tmp_path: Path):
    model = tmp_path / "model.rvm"
    for wrong, words in (("noon", "UTC date"), ("0031-05-04", "year 31 is no date")):
        with pytest.raises(RendezviewError, match=words):
            track(model, tmp_path, tmp_path / "p.csv", epoch=wrong)
    with pytest.raises(RendezviewError, match="different files"):
        track(model, tmp_path, tmp_path / "p.csv", oem=tmp_path / "p.csv")
    guide = Guide(PathFollower(np.zeros(3), Shape.CIRCULAR))
    for oem, aem in ((tmp_path / "a", None), (None, tmp_path / "a")):
        with pytest.raises(RendezviewError, match="was fitted"):
            guide.finish(oem, aem, parse_epoch("2020-01-01"), "sat")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,q\n", "header"),
        ("time_s,qw,qx,qy,qz\n0,1,0,0,0\n", "two rows"),
        ("time_s,qw,qx,qy,qz\n0,1,0,0,0\n0,1,0,0,0\n", "rise"),
        ("time_s,qw,qx,qy,qz\n0,1,0,0,x\n1,1,0,0,0\n", "float"),
        ("time_s,qw,qx,qy,qz\n0,0,0,0,0\n1,1,0,0,0\n", "norm"),
    ],
)
def test_attitudes_of_the_chaser_are_checked(tmp_path: Path, text: str, words: str):
    path = tmp_path / "chaser.csv"
    path.write_text(text)
    with pytest.raises(RendezviewError, match=words):
        chaser_attitudes(path)


def test_attitudes_of_the_chaser_must_reach(tmp_path: Path):
    path = tmp_path / "chaser.csv"
    path.write_text("time_s,qw,qx,qy,qz\n0,1,0,0,0\n10,0,1,0,0\n")
    guide = Guide(PathFollower(np.zeros(3), Shape.CIRCULAR), chaser_attitudes(path))
    guide.update(*seen_at(5.0))
    with pytest.raises(RendezviewError, match="0 to 10 s"):
        guide.update(*seen_at(11.0))


def test_an_unknown_shape_is_refused():
    with pytest.raises(RendezviewError, match="circular, spiral"):
        Guide.of(np.zeros(3), None, "square", None, True)


DATES = [1.79e9, 1.79e9 + 1.0]  # 21 September 2026


@pytest.mark.parametrize(
    ("text", "times_s", "year"),
    [
        (None, DATES, 1970),
        ("1970-01-01", DATES, 1970),
        ("1970-01-01T00:00:00Z", DATES, 1970),
        (None, [0.0, 1.0], 2000),
        (None, [], 2000),
        ("2026-09-21T10:00:00", [0.0, 1.0], 2026),
        ("2026-09-21T10:00:00", [86400.0 * 365, 86400.0 * 366], 2026),
    ],
)
def test_times_since_1970_count_from_there(text, times_s, year):
    epoch, words = epoch_of(text, times_s)
    assert epoch.year == year
    assert (words is not None) == (year == 2000)


def test_an_epoch_that_contradicts_the_times_is_refused():
    for text in ("2026-09-21T10:00:00", "2000-01-01T12:00:00"):
        with pytest.raises(RendezviewError, match="dates themselves, from 2026-09-21T"):
            epoch_of(text, DATES)
    with pytest.raises(RendezviewError, match=r"1\.79e\+12 s is no date: give times in seconds"):
        orbit_message(epoch_of(None, DATES)[0], [1.79e12], [[1, 2, 3]], [[0, 0, 0]], frame="RSW")
