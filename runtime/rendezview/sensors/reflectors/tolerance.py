"""Diameter and blur of the dots, where they differ from what the target file and options say.

Dots that are printed larger look larger than expected at their range, and so they do in a camera
out of focus: no triplet passes. Then other diameters and blurs are tried. All that find the target
must find the same pose. The sizes of the found spots say which diameter or blur it is.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.reflectors.acquisition import Acquirer
from rendezview.sensors.reflectors.acquisition_options import Acquisition, AcquisitionOptions
from rendezview.sensors.reflectors.discs import camera_numbers
from rendezview.sensors.reflectors.matching import expect_spots
from rendezview.sensors.reflectors.pattern import ReflectorPattern
from rendezview.sensors.reflectors.spots import SpotTable

# × the diameter and × the blur: steps of about twice what one acquisition tolerates. Source: by
# construction, from acquisition_options.py: diameter_sigma, blur_sigma, size_limit
_DIAMETERS = (1.0, 0.87, 1.15, 0.75, 1.33)
# Source: by construction, likewise
_BLURS = (1.0, 1.4, 0.7, 2.0, 2.8, 4.0, 5.5)
_MOST_SPOTS = 20  # in a crowd chance would fit some size. Source: experiment reflector-tolerance
_LEAST_SURE = 8.0  # χ² of the triplet at most. Source: as AcquisitionOptions.sparse_limit
_SAME_SHARE = 0.02  # of the range, between poses that agree. Source: by construction, 5 × the error
_BLURRED = 0.75  # blur over size from which a size tells the blur. Source: by construction, σ / 2
_TOLD_DIAMETER, _TOLD_BLUR = 0.05, 0.25  # ln, that is worth a word. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Patterns and options that fit the dots, and what is different in words."""

    patterns: list[ReflectorPattern]
    options: AcquisitionOptions
    found: Acquisition
    note: str | None


def scaled(patterns: list[ReflectorPattern], factor: float) -> list[ReflectorPattern]:
    """The same patterns with larger or smaller discs."""
    return [replace(p, diameters_m=factor * p.diameters_m) for p in patterns]


def fit_dots(
    camera: Camera, patterns: list[ReflectorPattern], options: AcquisitionOptions, spots: SpotTable
) -> Fitted | None:
    """Diameter and blur at which the spots are the target; None where none or several are."""
    if not 3 <= len(spots) <= _MOST_SPOTS:
        return None
    best: tuple[float, float, float, Acquisition] | None = None
    # One thing that is different is likelier than two.
    for trials in (
        [(diameter, 1.0) for diameter in _DIAMETERS], [(1.0, blur) for blur in _BLURS],
        list(itertools.product(_DIAMETERS[1:], _BLURS[1:])),
    ):  # fmt: skip
        for diameter, blur in trials:
            trial = replace(options, blur_px=blur * options.blur_px)
            found = Acquirer(camera, scaled(patterns, diameter), trial).acquire(spots)
            if found.refined is None or found.score > _LEAST_SURE:
                continue
            if best is not None and not _agree(best[3], found):
                return None
            if best is None or found.score < best[0]:
                best = found.score, diameter, blur, found
        if best is not None:
            break
    if best is None:
        return None
    _, diameter, blur, found = best
    step, share = _size_error(
        camera, scaled(patterns, diameter), replace(options, blur_px=blur * options.blur_px), found,
        spots,
    )  # fmt: skip
    if share < _BLURRED:
        diameter *= math.exp(step / (1.0 - share * share))
    else:
        blur *= math.exp(step / (share * share))
    fitted = replace(options, blur_px=blur * options.blur_px)
    return Fitted(scaled(patterns, diameter), fitted, found, _words(diameter, blur, fitted.blur_px))


def _agree(one: Acquisition, other: Acquisition) -> bool:
    assert one.refined is not None
    assert other.refined is not None
    first, second = one.refined.camera_from_target, other.refined.camera_from_target
    away = np.linalg.norm(first.translation_m - second.translation_m)
    return bool(away < _SAME_SHARE * np.linalg.norm(first.translation_m))


def _size_error(
    camera: Camera,
    patterns: list[ReflectorPattern],
    options: AcquisitionOptions,
    found: Acquisition,
    spots: SpotTable,
) -> tuple[float, float]:
    """Mean ln of size over expected size, and mean share of the blur in the size."""
    assert found.refined is not None
    constellation = Acquirer(camera, patterns, options).constellation
    pose: Pose = found.refined.camera_from_target
    expected = np.empty((len(constellation), 3))
    expect_spots(
        camera_numbers(camera, options.blur_px), constellation.positions_m, constellation.normals,
        constellation.diameters_m, np.ascontiguousarray(pose.rotation),
        np.ascontiguousarray(pose.translation_m), camera.fx, options.blur_px, expected,
    )  # fmt: skip
    sizes = expected[found.reflectors, 2]
    errors = np.log(spots.size_px[found.spot_indices] / sizes)
    return float(errors.mean()), float(np.minimum(options.blur_px / sizes, 1.0).mean())


def _words(diameter: float, blur: float, blur_px: float) -> str | None:
    words = []
    if abs(math.log(diameter)) > _TOLD_DIAMETER:
        kind = "larger" if diameter > 1.0 else "smaller"
        words.append(
            f"dots measure {100.0 * abs(diameter - 1.0):.0f} % {kind} than the target file says"
        )
    if abs(math.log(blur)) > _TOLD_BLUR:
        words.append(f"the blur is {blur_px:.1f} px (one σ): give --blur {blur_px:.1f}")
    return "; ".join(words) or None
