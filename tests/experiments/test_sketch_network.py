"""Experiment sketch-network: its processes, its held-out pictures, what it says without PyTorch."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from experiments.training import sketch_frames, sketch_network
from experiments.training.sketch_frames import CraftDrawing, draw_craft
from rendezview.sensors.appearance.edges.network import SIDE_PX
from rendezview.sensors.appearance.model.sketches import COVER, MAPS


def test_without_pytorch_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match="pip install torch"):
        sketch_network.run(tmp_path / "sketch.onnx")
    assert not any(tmp_path.iterdir())


def test_a_part_is_the_same_for_a_seed_in_both_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sketch_network, "LEAST_POOL", 4)
    first, again, other = (sketch_network.part((seed, 1), (2, 1)) for seed in (5, 5, 6))
    for k, side in enumerate((SIDE_PX, sketch_network.LARGE * SIDE_PX)):
        pictures, maps = first[k]
        assert pictures.shape == (2 - k, side, side)
        assert maps.shape == (2 - k, MAPS, side, side)
        assert (maps[:, COVER].max((1, 2)) == 255).any()
        np.testing.assert_array_equal(pictures, again[k][0])
        np.testing.assert_array_equal(maps, again[k][1])
        assert not np.array_equal(pictures, other[k][0])


def test_a_pool_draws_anew_after_so_many_photographs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sketch_network, "LEAST_POOL", 4)
    drawn = []

    def counted(*args: Any) -> CraftDrawing:
        drawn.append(draw_craft(*args))
        return drawn[-1]

    monkeypatch.setattr(sketch_frames, "draw_craft", counted)
    pool = sketch_network.Pool(np.random.default_rng(1), reuse=4.0)
    pool.photographs(8, 1)
    assert len(drawn) == 4
    pool.photographs(8, 1)
    assert len(drawn) == 6


@pytest.fixture
def threads_of_opencv() -> Iterator[None]:
    """OpenCV's own threads, as many tests leave them; a child of a fork does not have them."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    cv2.GaussianBlur(np.zeros((2000, 2000), np.uint8), (0, 0), 3.0)
    yield
    cv2.setNumThreads(before)


# Python 3.12 warns of any fork beside threads: the children use none of theirs.
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.usefixtures("threads_of_opencv")
def test_processes_feed_different_batches_until_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sketch_network, "LEAST_POOL", 4)
    monkeypatch.setattr(sketch_network, "MOST_S", 60.0)
    monkeypatch.setattr(sketch_network, "LARGE_SHARE", 0.5)
    feed = sketch_network.batches(1, 4, 4.0, seed=3)
    shapes, sums = set(), set()
    for pictures, maps in itertools.islice(feed, 8):
        assert pictures.size == 4 * SIDE_PX**2
        assert maps.size == MAPS * pictures.size
        shapes.add(pictures.shape)
        sums.add(float(pictures.astype(np.float64).sum()))
    assert shapes == {(4, SIDE_PX, SIDE_PX), (1, 2 * SIDE_PX, 2 * SIDE_PX)}
    assert len(sums) == 8
    before = multiprocessing.active_children()
    feed.close()
    assert len(multiprocessing.active_children()) == len(before) - 1


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.usefixtures("threads_of_opencv")
def test_a_process_that_ends_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sketch_network, "_batch", os._exit)
    with pytest.raises(BrokenProcessPool):
        next(sketch_network.batches(1, 4, 4.0, seed=3))
