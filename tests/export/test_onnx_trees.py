"""The trees as an ONNX graph decide as the runtime does."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.export import write_onnx
from rendezview.sensors.appearance.outline.votes import Matcher


def test_the_graph_decides_as_the_runtime(tiny_model, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    path = tmp_path / "trees.onnx"
    write_onnx(tiny_model, path)
    session = onnxruntime.InferenceSession(path)
    rng = np.random.default_rng(1)
    forest, matcher, bins = tiny_model.forest, Matcher(tiny_model), tiny_model.bins
    nodes = np.arange(len(forest))
    ons = 0
    for k in range(300):
        view = tiny_model.views.readings[rng.integers(len(tiny_model.views.readings))]
        readings = np.rint(view * (1.0 + 0.05 * rng.normal(size=bins))).astype(np.float32)
        rolls = rng.uniform(-np.pi, np.pi, len(nodes))
        if k % 10 == 0:
            rolls = np.pi / bins * rng.integers(-bins, bins + 1, len(nodes))
        trust = matcher.trust_of(forest.leaves(readings, nodes, rolls))
        given, on = session.run(["trust", "on"], {"readings": readings, "rolls_rad": rolls})
        assert np.array_equal(on, trust > 0.0)
        assert np.array_equal(given, trust.astype(np.float32))
        ons += np.count_nonzero(on)
    assert ons > 300


def test_the_same_model_gives_the_same_graph(tiny_model, tmp_path):
    pytest.importorskip("onnx", reason="onnx is not installed")
    write_onnx(tiny_model, tmp_path / "a")
    write_onnx(tiny_model, tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_without_the_package_it_says_what_to_install(tiny_model, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(RendezviewError, match=r"rendezview\[onnx\]"):
        write_onnx(tiny_model, tmp_path / "trees.onnx")
    assert not list(tmp_path.iterdir())
