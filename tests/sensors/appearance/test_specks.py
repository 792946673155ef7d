"""Speckled frames: their silhouettes take time by pixels, not by blobs: few of them are traced."""

from __future__ import annotations

from functools import cache
from types import ModuleType

import cv2
import numpy as np
import pytest

from rendezview.sensors.appearance.outline import silhouette
from rendezview.sensors.appearance.outline.silhouette import (
    Cleaning,
    Missing,
    Silhouette,
    SilhouetteOptions,
    Threshold,
    find_silhouette,
    outer_borders,
)
from rendezview.sensors.appearance.outline.specks import (
    MOST_BLOBS,
    SPECKLED,
    blob_starts,
    without_specks,
)

SIZE = (1200, 1920)
DISC = ((1000, 560), 250)  # centre and radius, px


@cache
def speckled(body: bool = True) -> np.ndarray:
    """A frame of noise in which half the grey levels leave 40,000 blobs, and a disc."""
    rng = np.random.default_rng(13)
    frame = np.clip(rng.normal(30.0, 12.0, SIZE), 0, 255).astype(np.uint8)
    frame[:4], frame[-4:], frame[:, :4], frame[:, -4:] = 30, 30, 30, 30
    if body:
        cv2.circle(frame, *DISC, 220, -1)
    return frame


def traced_by(module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of blobs that a module has traced from now on, mask by mask."""
    counts = []

    def noted(mask: np.ndarray) -> list:
        borders = outer_borders(mask)
        counts.append(len(borders))
        return borders

    monkeypatch.setattr(module, "outer_borders", noted)
    return counts


def test_starts_of_blobs_are_counted_in_a_sample_of_the_rows():
    rng = np.random.default_rng(1)
    mask = np.where(rng.random((203, 117)) > 0.7, 255, 0).astype(np.uint8)
    lit = mask > 0
    met = lit[:-1, :-2] | lit[:-1, 1:-1] | lit[:-1, 2:] | lit[1:, :-2]
    starts = (lit[1:, 1:-1] & ~met)[6::8]
    assert blob_starts(mask) == 8 * np.count_nonzero(starts)
    mask[:] = 0
    assert blob_starts(mask) == 0


def test_a_mask_with_few_blobs_is_left_as_it_is():
    mask = np.zeros(SIZE, dtype=np.uint8)
    mask[100:-100:40, 100:-100:40] = 255  # 1125 specks
    assert without_specks(mask) is mask


def test_the_largest_blobs_of_a_speckled_mask_are_kept():
    mask = np.where(cv2.blur(speckled(), (3, 3)) > 36, 255, 0).astype(np.uint8)
    borders = outer_borders(mask)
    assert len(borders) > 4 * SPECKLED
    kept = outer_borders(without_specks(mask))
    assert 0 < len(kept) <= MOST_BLOBS
    assert max(map(len, kept)) == max(map(len, borders))


@pytest.mark.parametrize("cleaning", list(Cleaning))
@pytest.mark.parametrize(
    "options",
    [{"threshold": "otsu"}, *({"threshold": "fixed", "level_grey": 30.0 + k} for k in (5, 15, 25))],
)
def test_a_silhouette_in_a_speckled_frame_is_one_of_few_blobs(options, cleaning, monkeypatch):
    traced = traced_by(silhouette, monkeypatch)
    options = options | {"threshold": Threshold(options["threshold"])}
    for averaged in (1, 3):
        chosen = SilhouetteOptions(**options, cleaning=cleaning, averaged_px=averaged)
        for frame in (speckled(), speckled(False)):
            found = find_silhouette(frame, chosen)
            if isinstance(found, Silhouette):
                assert len(found.outlines_px) <= MOST_BLOBS
    assert max(traced) <= SPECKLED


def test_the_body_of_a_speckled_frame_is_found():
    found = find_silhouette(
        speckled(), SilhouetteOptions(threshold=Threshold.FIXED, level_grey=45.0, merge_gap=0.0)
    )
    assert isinstance(found, Silhouette)
    assert found.area_px == pytest.approx(np.pi * DISC[1] ** 2, rel=0.01)


def test_of_a_sketch_that_is_speckled_few_blobs_are_traced(monkeypatch):
    odds = np.random.default_rng(2).normal(-1.0, 1.5, SIZE)
    traced = traced_by(silhouette, monkeypatch)
    body = silhouette.silhouette_of_mask(
        np.where(odds > 0.5, 255, 0).astype(np.uint8), SilhouetteOptions()
    )
    assert max(traced) <= MOST_BLOBS
    assert isinstance(body, Missing)
