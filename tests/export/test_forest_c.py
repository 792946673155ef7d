"""The forest as C: the scores and active nodes with which the runtime decides, bit for bit."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.export.driver import (
    SANITIZED,
    ActiveNodes,
    FlightCode,
    build,
    compiler,
    object_bytes,
    same_match,
)

from rendezview.export.c_code import model_files
from rendezview.export.tables import pack_score_forest, windows_of
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.forest import BINS
from rendezview.sensors.appearance.model.signature import Signature, rebinning
from rendezview.sensors.appearance.outline.votes import Matcher

SIGNATURES = 4000
pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")


@pytest.fixture(scope="module")
def code(tmp_path_factory: pytest.TempPathFactory, forest_model: ViewModel) -> Iterator[FlightCode]:
    folder = tmp_path_factory.mktemp("flight") / "code"
    with FlightCode(build(forest_model, folder, SANITIZED), forest_model) as running:
        yield running


def some_view(model: ViewModel, rng: np.random.Generator) -> tuple[Signature, np.ndarray]:
    """A perturbed view of the model, and an attitude near it or near another, at any roll."""
    k, other = rng.integers(len(model.views.readings), size=2)
    readings = model.views.readings[k] * (1.0 + 0.1 * rng.uniform() * rng.normal(size=model.bins))
    if rng.uniform() < 0.3:  # whole units of the forest, so that readings equal thresholds
        readings = 16.0 * np.rint(readings / 16.0)
    if rng.uniform() < 0.05:
        readings *= 8.0  # beyond what a bin of the forest holds
    readings = np.rint(np.maximum(readings, 0.0)).astype(np.float32)
    roll = np.pi * rng.choice([0.0, 1.0, 2.0 / BINS, rng.uniform(-1.0, 1.0)])
    tilt = 0.1 * rng.normal(size=3) * rng.integers(2)
    turn = Rotation.from_rotvec([0.0, 0.0, roll]) * Rotation.from_rotvec(tilt)
    attitude = turn.as_matrix() @ model.views.centred_from_target[k if rng.integers(3) else other]
    return Signature(readings, 0.01, np.eye(3)), attitude


@pytest.mark.requirement("RV-CODE-1")
def test_the_score_of_an_attitude_is_that_of_the_runtime(code, forest_model):
    rng, forest = np.random.default_rng(1), forest_model.forest_scores()
    scores = set()
    for _ in range(SIGNATURES):
        signature, attitude = some_view(forest_model, rng)
        score = float(forest.scores(signature, attitude[None])[0])
        assert code.forest_score(signature.readings, attitude) == score
        scores.add(score)
    assert len(scores) > SIGNATURES // 3


@pytest.mark.requirement("RV-CODE-1")
def test_the_forest_finds_the_active_nodes_of_the_runtime(code, forest_model):
    rng, matcher = np.random.default_rng(2), Matcher(forest_model)
    reach = (matcher.options.margin_edges + 2.0) * forest_model.geodesic.mean_edge_rad
    found = []
    for _ in range(1000):
        signature, attitude = some_view(forest_model, rng)
        match = matcher.at(signature, Pose(attitude, np.array([0.0, 0.0, 10.0])))
        c = code.forest_search(signature.readings, attitude, reach)
        assert same_match(c, match)
        if isinstance(c, ActiveNodes):
            assert c.support == pytest.approx(c.weights.sum())
            found.append(len(c.nodes))
    assert len(found) > 500
    assert len(set(found)) > 5


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_numbers_that_are_none_are_refused(code, forest_model, bad):
    signature, attitude = some_view(forest_model, np.random.default_rng(3))
    attitude[2, 1] = bad
    assert code.forest_score(signature.readings, attitude) == "bad input"
    assert code.forest_search(signature.readings, attitude, 0.5) == "bad input"
    assert code.forest_search(signature.readings, np.eye(3), np.nan) == "bad input"


def test_a_view_between_all_nodes_has_the_least_score(code, forest_model):
    signature, _ = some_view(forest_model, np.random.default_rng(4))
    none = np.zeros((3, 3))  # looks nowhere, so no node is near
    least = forest_model.forest_scores().scores(signature, none[None])[0]
    assert code.forest_score(signature.readings, none) == least == -127.0 / 16.0


@pytest.mark.parametrize("bins", [8, 90, 100, 120, 360, 4096])
def test_the_windows_average_as_the_runtime(bins):
    starts, windows = windows_of(bins)
    dense = np.zeros((bins, BINS), dtype=np.float32)
    for k, (start, window) in enumerate(zip(starts, windows, strict=True)):
        dense[(start + np.arange(len(window))) % bins, k] = window
    assert np.array_equal(dense, rebinning(bins, BINS))


def test_the_header_tells_the_size_and_the_depth(forest_model, tmp_path):
    taken = object_bytes(forest_model, tmp_path)["rendezview_forest.c"]
    header = model_files(forest_model)[0]
    told = int(header.split("RDV_FOREST_BYTES ")[1].split("u")[0])
    assert told <= taken < told + 400
    assert "#define RDV_FOREST_DEPTH 7u " in header
    assert pack_score_forest(forest_model).depth == 7


@pytest.mark.skipif(shutil.which("nm") is None, reason="there is no nm here")
def test_without_a_forest_the_header_says_so_and_nothing_is_left(tiny_model, tmp_path: Path):
    object_bytes(tiny_model, tmp_path)
    assert "#define RDV_FOREST_TREES 0u " in (tmp_path / "rendezview_model.h").read_text()
    for name in ("forest.o", "rendezview_forest.o"):
        command = ["nm", "--defined-only", tmp_path / name]
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert said == "", name


def test_every_line_fits_a_terminal(forest_model):
    for text in model_files(forest_model):
        assert max(map(len, text.splitlines())) <= 100
