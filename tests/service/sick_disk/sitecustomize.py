"""A disk that hangs, for the processes of a service that find this folder in PYTHONPATH.

While the file that SICK_DISK names exists, no write to a log returns.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

_sign = Path(os.environ["SICK_DISK"])
_writev = os.writev


def _hangs(file: int, pieces: Sequence[memoryview]) -> int:
    while _sign.exists():
        time.sleep(0.01)
    return _writev(file, pieces)


os.writev = _hangs
