"""Photodiode: eq. 1, 2 and 5, noise, and the scan that calibrates it."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.sensors.beacons import Normalisation, Photodiode, Response
from rendezview.sensors.beacons.detect.photodiode import fit_response, terms
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions

SIDE = np.linspace(-0.9, 0.9, 30) * 0.005
BEAM = np.stack(np.meshgrid(SIDE, SIDE), axis=-1).reshape(-1, 2)


def currents_of(x: float, y: float, light: float = 2.0) -> np.ndarray:
    return 0.25 * light * np.array([1 + x, 1 - x, 1 + y, 1 - y])


@pytest.mark.parametrize("normalisation", Normalisation)
def test_equations_1_and_2_give_the_place(normalisation: Normalisation):
    diode = Photodiode(Response.linear(0.005, normalisation), noise=1e-4)
    spots = diode.read([currents_of(0.3, -0.6), currents_of(0.0, 0.1, light=0.5)])
    assert spots.positions == pytest.approx(0.005 * np.array([[0.3, -0.6], [0.0, 0.1]]), abs=1e-15)
    assert spots.led.tolist() == [0, 1]


@pytest.mark.parametrize("order", [3, 5])
def test_a_polynomial_response_is_found_exactly(order: int):
    rng = np.random.default_rng(1)
    count = {3: 10, 5: 21}[order]
    truth = rng.normal(0.0, 1e-4, (2, count))
    truth[0, 1] = truth[1, 2] = 0.005
    reading = BEAM / 0.006
    light = np.stack([currents_of(*place) for place in reading])
    fit = fit_response(terms(reading, order) @ truth.T, light, order=order)
    assert fit.response.coefficients == pytest.approx(truth, abs=1e-12)
    diode = Photodiode(fit.response, noise=1e-5)
    assert diode.read(light[:7]).positions == pytest.approx(fit.response.positions(light[:7]))


@pytest.mark.parametrize("normalisation", Normalisation)
def test_sigma_is_the_scatter_of_repeated_readings(normalisation: Normalisation):
    rng = np.random.default_rng(2)
    bent = np.zeros((2, 21))
    bent[0, 1] = bent[1, 2] = 0.005
    bent[0, 8], bent[1, 6], bent[0, 15], bent[1, 20] = 4e-4, 3e-4, 2e-4, -3e-4
    diode = Photodiode(Response(bent, normalisation), noise=0.005)
    exact = currents_of(0.7, -0.4)
    places = np.array(
        [diode.read([exact + rng.normal(0.0, 0.005, 4)]).positions[0] for _ in range(8000)]
    )
    assert diode.read([exact]).sigma[0] == pytest.approx(places.std(axis=0), rel=0.04)


def test_total_light_scatters_less_than_pairs_near_the_edge():
    exact, noise = currents_of(0.9, 0.0), 0.005
    sigma = {
        kind: Photodiode(Response.linear(0.005, kind), noise).read([exact]).sigma[0, 0]
        for kind in Normalisation
    }
    assert sigma[Normalisation.TOTAL] < 0.92 * sigma[Normalisation.PAIR]


def test_a_scan_takes_the_pin_cushion_down_to_the_noise():
    laboratory = Laboratory(np.zeros((3, 3)), LaboratoryOptions(), seed=4)
    rng = np.random.default_rng(4)
    scan = laboratory.light(0, BEAM) + rng.normal(0.0, laboratory.noise, (60, len(BEAM), 4))
    fit = fit_response(BEAM, scan, order=5)
    noise_m = 0.005 * laboratory.noise / np.sqrt(60) * np.sqrt(2.0) / 0.9
    assert fit.linear_rms_m > 5.0 * fit.rms_m
    assert fit.rms_m == pytest.approx(noise_m, rel=0.2)
    assert fit.electrode_sigma == pytest.approx(laboratory.noise, rel=0.01)


def test_weak_dark_and_broken_lights_are_not_seen():
    diode = Photodiode(Response.linear(0.005), noise=0.005)
    off, weak = np.zeros(4), currents_of(0.1, 0.1, light=0.1)
    broken, outside = np.full(4, np.nan), np.array([1.0, -0.2, 0.4, 0.4])
    spots = diode.read([off, currents_of(0.2, 0.2), weak, broken, outside])
    assert spots.led.tolist() == [1]


@pytest.mark.parametrize(
    ("beam", "scan"),
    [
        (BEAM[:30], np.ones((30, 4))),
        (BEAM, np.ones((len(BEAM), 3))),
        (BEAM, np.full((len(BEAM), 4), np.nan)),
        (BEAM, np.zeros((len(BEAM), 4))),
        (BEAM * [1.0, 0.0], np.ones((len(BEAM), 4))),
    ],
)
def test_scans_that_determine_nothing_are_refused(beam: np.ndarray, scan: np.ndarray):
    with pytest.raises(ValueError, match=r"scan|currents"):
        fit_response(beam, scan)


@pytest.mark.parametrize("normalisation", list(Normalisation))
@pytest.mark.parametrize("count", [10, 21])
def test_places_have_the_slopes_of_the_response_and_faint_or_outer_lights_are_left_out(
    normalisation: Normalisation, count: int
):
    rng = np.random.default_rng(5)
    coefficients = rng.normal(0.0, 3e-4, (2, count))
    coefficients[0, 1] += 0.005
    coefficients[1, 2] += 0.005
    response, noise = Response(coefficients, normalisation), 0.02
    currents = rng.uniform(0.0, 1.0, (300, 4))
    currents[0], currents[1, 2], currents[2, 0] = 0.0, np.nan, np.inf
    bright = np.isfinite(currents).all(axis=1)
    bright[bright] = np.minimum(*(currents[bright].reshape(-1, 2, 2).sum(axis=2).T)) > 30.0 * noise
    places, h = response.positions(currents[bright]), 1e-6
    inside = (np.abs(places) <= 1.05 * 0.004).all(axis=1)
    found = Photodiode(response, noise, 0.004).read(currents)
    assert 50 < len(found) < bright.sum() < 300  # all three cases occur: read, outside, too weak
    np.testing.assert_array_equal(found.led, np.flatnonzero(bright)[inside])
    np.testing.assert_allclose(found.positions, places[inside])
    read = currents[found.led]
    ends = [(response.positions(read + s), response.positions(read - s)) for s in h * np.eye(4)]
    slopes = np.array([ahead - behind for ahead, behind in ends]) / (2.0 * h)
    np.testing.assert_allclose(found.sigma, noise * np.sqrt((slopes**2).sum(axis=0)), rtol=0.3)
