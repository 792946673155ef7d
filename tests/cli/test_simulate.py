"""``rendezview simulate``: what photographs have, from the command line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def test_options_of_photographs_reach_the_pictures(run, mesh_path: Path, tmp_path: Path):
    words = ["--trajectory", "circular", "--frames", 1, "--start-range", 12, "--jobs", 1,
             "--noise", 0, "--jitter", 0, "--sun-phase", 40]  # fmt: skip
    changes = {
        "plain": [],
        "default": ["--overexposure", 1, "--bloom", 0, "--black-level", 5, "--sky-level", 0,
                    "--dust", 0, "--mesh-error", 0],
        "bright": ["--overexposure", 6],
        "bloom": ["--overexposure", 6, "--bloom", 0.1],
        "black": ["--black-level", 30],
        "sky": ["--sky-level", 40],
        "dust": ["--dust", 40],
        "mesh": ["--mesh-error", 0.05],
    }  # fmt: skip
    seen = {}
    for name, options in changes.items():
        ran = run("simulate", mesh_path, "-o", tmp_path / name, *words, *options)
        assert ran.code == 0, ran.err
        image = cv2.imread(str(tmp_path / name / "gray" / "000000.png"), 0)
        assert image is not None
        seen[name] = image.astype(int)
    plain = seen["plain"]
    np.testing.assert_array_equal(seen["default"], plain)
    sky = cv2.dilate((plain > 5).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    lit = plain > 150
    assert plain.max() < 255
    assert (seen["bright"][lit] == 255).all()
    assert (seen["bright"][sky] == 5).all()
    assert (seen["bloom"][sky] > 5).mean() > 0.1
    assert (seen["black"][sky] == 30).all()
    assert (seen["sky"][sky] == 45).all()
    assert (seen["dust"] - plain)[sky].max() > 20
    assert 0 < np.mean((seen["mesh"] != plain)[sky]) < 0.1
