"""Another Python process, as a user's."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from tests.waiting import MOST_S


def python(*words: object, **more: Any) -> subprocess.CompletedProcess[str]:
    """What it says, and its return code."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=MOST_S, **more
    )
