"""What long work says where there is no terminal: plain lines on stderr, as in the log of a job."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from rendezview.cli.progress import _Stage

# Limits of a test in place of half a minute.
_SOON = """
import sys, time
from rendezview.cli import progress
progress._EVERY_S, progress._END_S = float(sys.argv.pop(1)), float(sys.argv.pop(1))
"""
_COMMAND = f"{_SOON}\nfrom rendezview.cli.main import main\nmain()"
_WORK = f"""{_SOON}
with progress.ProgressBar() as bar:
    done = bar.stage("views", 4)
    time.sleep(1.0)
    for k in range(4):
        done(k + 1)
    time.sleep(1.0)
    bar.stage("readings", 0)(7)
"""


def said(program: str, *words: str) -> list[str]:
    """The lines of a program on stderr; there are none on stdout."""
    run = subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True, text=True, check=True,
        env=os.environ | {"FORCE_COLOR": "1"},  # as CI systems set it: rich takes it for a terminal
    )  # fmt: skip
    assert run.stdout == ""
    assert "\r" not in run.stderr
    assert "\x1b[?" not in run.stderr  # no cursor is hidden
    assert "\x1b[1A" not in run.stderr  # none moves up
    return run.stderr.splitlines()


def test_a_command_says_how_far_it_is_and_when_a_stage_ends(tmp_path):
    lines = said(
        _COMMAND, "60", "0", "simulate", "hubble", "-o", str(tmp_path / "s"), "--trajectory",
        "spiral", "--frames", "6", "--jobs", "1",
    )  # fmt: skip
    told = [line for line in lines if line.startswith("frames:")]
    assert re.fullmatch(r"frames: 6 of 6 in \d+ s", told[-1])
    assert lines[-1] == f"{tmp_path / 's'}: 6 frames"


def test_work_that_counts_nothing_is_no_silence(tmp_path):
    lines = said(_WORK, "0.3", "0.3")
    assert lines[0] == "views: 0 of 4, 0 s so far"
    assert re.fullmatch(r"views: 4 of 4 in 1 s; what follows takes [01] s so far", lines[-1])
    assert 3 <= len(lines) <= 8  # of seven intervals and one end; none for what has no end


def test_short_work_says_nothing():
    assert said(_WORK, "30", "10") == []


@pytest.mark.parametrize(
    ("done", "first", "left_s", "words"),
    [
        (30, 0, None, "trees: 30 of 120, about 90 s more"),  # 30 in 30 s
        (60, 50, None, "trees: 60 of 120, about 3 min more"),  # 10 in 30 s
        (30, 0, 7.0, "trees: 30 of 120, about 7 s more"),  # better known by the work itself
        (50, 50, None, "trees: 50 of 120, 30 s so far"),
        (120, 0, None, "trees: 120 of 120 in 20 s; what follows takes 10 s so far"),
    ],
)
def test_the_time_left_is_at_the_rate_since_the_stage_began(done, first, left_s, words):
    stage = _Stage("trees", done, 120, first, began_s=100.0, updated_s=120.0, left_s=left_s)
    assert stage.words(130.0) == words


def test_a_stage_that_ends_says_how_long_it_took():
    assert _Stage("trees", 120, 120, 0, 100.0, 340.0).words(340.0) == "trees: 120 of 120 in 4 min"
