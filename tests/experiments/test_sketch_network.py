"""Experiment sketch-network: its drawings on disk, and what it says without PyTorch."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.training import sketch_network
from rendezview.sensors.appearance.edges.network import SIDE_PX
from rendezview.sensors.appearance.model.sketches import MAPS
from rendezview_ground.simulate.sketch_frames import DRAWINGS


def test_without_pytorch_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match="pip install torch"):
        sketch_network.run(tmp_path / "sketch.onnx", folder=tmp_path / "frames")
    assert not any(tmp_path.iterdir())


def test_drawings_are_kept_and_read_again(tmp_path: Path) -> None:
    first = sketch_network.drawings(tmp_path, 7, seed=3)
    files = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert len(first) == 2 * DRAWINGS
    again = sketch_network.drawings(tmp_path, 7, seed=3)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == files
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.maps, b.maps)
        np.testing.assert_array_equal(a.light, b.light)
    behind = sketch_network.skies(tmp_path, 2, seed=3)
    pictures, maps = sketch_network.photographs(first[:3], behind, np.random.default_rng(1))
    assert pictures.shape == (3, 2, SIDE_PX, SIDE_PX)
    assert maps.shape == (3, MAPS, SIDE_PX, SIDE_PX)
    assert 0.0 <= pictures[:, 0].min() < pictures[:, 0].max() <= 1.0
    assert np.abs(pictures[:, 1]).max() <= 1.0
