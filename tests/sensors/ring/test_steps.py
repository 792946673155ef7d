"""Blurred steps along an ellipse, on pictures drawn from the very model."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from rendezview.estimation.edge_profile import step_basis, step_filters
from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.sensors.ring.lip_fit import fit_lip
from rendezview.sensors.ring.samples import COLUMNS, OFFSET, WEIGHT
from rendezview.sensors.ring.step_fit import fit_steps
from rendezview.sensors.ring.steps import sample_steps

BLUR_PX = 0.85  # of the picture: reading it between pixels adds the rest
SHAPE = np.array([101.3, 99.6, 60.2, 0.0, 60.2])


def places(gap_px, near_grey, far_grey, windows=None):
    """Weighted mean and number of the offsets of a circle with another edge beside it."""
    rng = np.random.default_rng(4)
    rows, columns = np.mgrid[:200, :200].astype(float)
    off = np.hypot(columns - SHAPE[0], rows - SHAPE[1]) - SHAPE[2]
    grey = 150.0 + (near_grey - 150.0) * ndtr(off / BLUR_PX)
    grey += (far_grey - near_grey) * ndtr((off - gap_px) / BLUR_PX)
    image = np.clip(np.rint(grey + 2.0 * rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8)
    lens = np.append(lens_vector(Camera(200, 200, 200.0, 200.0, 99.5, 99.5)), 0.0)
    samples = np.zeros((400, COLUMNS))
    filters = step_filters(0.9)[:windows]
    count = sample_steps(
        image, lens, SHAPE, 1.0, 0.0, 2.0, filters, step_basis(0.9), 0.9, np.empty((0, 5)), samples
    )
    weights = np.maximum(samples[:count, WEIGHT], 0.0)
    return float(np.average(samples[:count, OFFSET], weights=weights)), int((weights > 0.0).sum())


def test_a_single_edge_is_where_it_is():
    mean_px, count = places(50.0, 60.0, 60.0)
    assert abs(mean_px) < 0.02
    assert count > 350


@pytest.mark.parametrize("gap_px", [3.0, 3.5])
def test_an_edge_beside_it_that_nobody_knows_of_does_not_draw_it_away(gap_px):
    mean_px, count = places(gap_px, 50.0, 95.0)
    assert abs(mean_px) < 0.12
    assert count > 200
    drawn_px, _ = places(gap_px, 50.0, 95.0, windows=1)  # by the whole profile
    assert abs(drawn_px) > 2.0 * abs(mean_px)


def test_a_rough_circle_is_fitted_to_its_steps_and_is_no_lip():
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[:200, :200].astype(float)
    off = np.hypot(columns - SHAPE[0], rows - SHAPE[1]) - SHAPE[2]
    grey = 150.0 - 90.0 * ndtr(off / BLUR_PX) + 2.0 * rng.standard_normal(off.shape)
    image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    lens = np.append(lens_vector(Camera(200, 200, 200.0, 200.0, 99.5, 99.5)), 0.0)
    filters, basis = step_filters(0.9), step_basis(0.9)
    fitted, covariances, facts, pairs = fit_steps(
        image, lens, SHAPE[None] + 0.4, 1.5, 2.0, filters, basis, 0.9, 1.3, 0.03
    )
    np.testing.assert_allclose(fitted, [SHAPE], atol=0.03)
    assert covariances.shape == (1, 5, 5)
    assert (np.sqrt(np.diagonal(covariances[0])) < 0.1).all()
    assert facts[0, 0] > 6.0  # the whole circle
    assert facts[0, 1] == pytest.approx(-90.0, abs=3.0)
    assert pairs.tolist() == [-1]
    samples = np.zeros((800, COLUMNS))
    used = sample_steps(
        image, lens, SHAPE, 1.0, 0.0, 2.0, filters, basis, 0.9, np.empty((0, 5)), samples[:400]
    )
    edges, spread, found = np.empty((2, 5)), np.empty((2, 5, 5)), np.empty((2, 4))
    assert not fit_lip(
        image, lens, SHAPE, 1.0, 2.0, filters, basis, 0.9, np.empty((0, 5)), samples, used,
        edges, spread, found,
    )  # fmt: skip
