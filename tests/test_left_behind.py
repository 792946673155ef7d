"""A process that outlives the tests is found, whoever started it."""

from __future__ import annotations

import subprocess
import sys

import pytest
from tests.left_behind import none_left_behind
from tests.waiting import MOST_S

ASLEEP = [sys.executable, "-c", "import time; time.sleep(600)"]
# Its child has no parent any more, which is how servers of other packages are left behind.
ORPHAN = [sys.executable, "-c", f"import subprocess; subprocess.Popen({ASLEEP})"]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")


def test_a_child_and_an_orphan_are_found_and_killed() -> None:
    check = none_left_behind(0.0)
    check.__enter__()
    child = subprocess.Popen(ASLEEP)
    subprocess.run(ORPHAN, check=True, timeout=MOST_S)
    with pytest.raises(AssertionError, match="left behind") as found:
        check.__exit__(None, None, None)
    assert str(found.value).count("time.sleep(600)") == 2
    assert f"{child.pid}: " in str(found.value)
    assert child.wait(MOST_S) < 0


def test_what_has_ended_is_not_left_behind() -> None:
    with none_left_behind():
        child = subprocess.Popen([sys.executable, "-c", ""])  # nobody waits for it yet
    assert child.wait(MOST_S) == 0
