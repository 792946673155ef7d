"""No package reports to its maker what runs here."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

# What a test's process may have set would keep them silent, too.
_SILENCING = ("CI", "TF_BUILD", "GITHUB_ACTIONS", "ORT_")

_DRAW = """
import numpy as np
from rendezview.sensors.appearance.edges.network import Sketcher
Sketcher().look(np.zeros((64, 64), np.uint8), (-0.5, -0.5, 63.5, 63.5))
"""


def test_a_sketch_leaves_no_number_of_this_machine_in_the_home_folder(tmp_path: Path):
    kept = {name: value for name, value in os.environ.items() if not name.startswith(_SILENCING)}
    kept |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / ".cache")}
    subprocess.run([sys.executable, "-c", _DRAW], env=kept, check=True)
    assert [str(path) for path in tmp_path.rglob("*") if "icrosoft" in str(path)] == []
