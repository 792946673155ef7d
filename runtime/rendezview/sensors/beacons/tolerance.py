"""Diameter and blur of the dots, where they differ from what the target file and options say.

Dots that are printed larger look larger than expected at their range, and so they do in a camera
out of focus: no triplet passes. Then other diameters and blurs are tried. All that find the target
must find the same pose. The sizes of the found spots say which diameter or blur it is. Dots that
differ less are found anyway; what their sizes say while they are followed is reported, too.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.discs import camera_numbers
from rendezview.sensors.beacons.detect.lens_scale import LensScale
from rendezview.sensors.beacons.detect.spots import MOST_CERTAIN, SpotTable
from rendezview.sensors.beacons.match.acquisition import Acquirer, merged
from rendezview.sensors.beacons.match.acquisition_options import Acquisition, AcquisitionOptions
from rendezview.sensors.beacons.match.matching import expect_spots

# × the diameter and × the blur: steps of about twice what one acquisition tolerates. Source: by
# construction, from acquisition_options.py: diameter_sigma, blur_sigma, size_limit
_DIAMETERS = (1.0, 0.87, 1.15, 0.75, 1.33)
# Source: by construction, likewise
_BLURS = (1.0, 1.4, 0.7, 2.0, 2.8, 4.0, 5.5)
_SAME_SHARE = 0.02  # of the range, between poses that agree. Source: by construction, 5 × the error
_BLURRED = 0.75  # blur over size from which a size tells the blur. Source: by construction, σ / 2
_REPORTED_DIAMETER, _REPORTED_BLUR = 0.05, 0.25  # ln, that is worth a word. Source: by construction
_REPORTED_SIGMA = (
    2.0  # of what a blur that is not known makes of the diameter. Source: by construction
)
_FEWEST, _READINGS = 3, 5  # whose diameters are averaged. Source: by construction
# × the range: nearer, the dots tell more and are measured again. Source: by construction
NEARER = 0.8


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
    if not 3 <= len(spots) <= MOST_CERTAIN:
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
            if found.refined is None or found.score > options.sparse_limit:
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
    assert found.refined is not None
    assert found.reflectors is not None
    step, share = _size_error(
        camera, merged(scaled(patterns, diameter)), blur * options.blur_px,
        found.refined.camera_from_target, found.reflectors, spots.size_px[found.spot_indices],
    )  # fmt: skip
    if share < _BLURRED:
        diameter *= math.exp(step / (1.0 - share * share))
    else:
        blur *= math.exp(step / (share * share))
    fitted = replace(options, blur_px=blur * options.blur_px)
    words = [] if abs(math.log(diameter)) < _REPORTED_DIAMETER else [_of_diameter(diameter)]
    if abs(math.log(blur)) > _REPORTED_BLUR:
        words.append(
            f"the blur is {fitted.blur_px:.1f} px (one σ): give --blur {fitted.blur_px:.1f}"
        )
    return Fitted(scaled(patterns, diameter), fitted, found, "; ".join(words) or None)


def _agree(one: Acquisition, other: Acquisition) -> bool:
    assert one.refined is not None
    assert other.refined is not None
    first, second = one.refined.camera_from_target, other.refined.camera_from_target
    away = np.linalg.norm(first.translation_m - second.translation_m)
    return bool(away < _SAME_SHARE * np.linalg.norm(first.translation_m))


def _size_error(
    camera: Camera,
    pattern: ReflectorPattern,
    blur_px: float,
    pose: Pose,
    which: npt.NDArray[np.int64],
    sizes_px: Array,
) -> tuple[float, float]:
    """Mean ln of size over expected size, and mean share of the blur in the size."""
    expected, scale = np.empty((len(pattern), 3)), LensScale(camera, blur_px)
    expect_spots(
        camera_numbers(camera, blur_px), pattern.positions_m, pattern.normals, pattern.diameters_m,
        pose.rotation.copy(), pose.translation_m.copy(), camera.fx,
        blur_px, expected,
    )  # fmt: skip
    scale.distort(expected)
    sizes = expected[which, 2]
    errors = np.log(sizes_px / sizes)
    return float(errors.mean()), float(np.minimum(blur_px / sizes, 1.0).mean())


def _of_diameter(factor: float) -> str:
    kind = "larger" if factor > 1.0 else "smaller"
    return f"dots measure {100.0 * abs(factor - 1.0):.0f} % {kind} than target.toml says"


class DotSizes:
    """The diameter of the dots while they are followed, beside what the target file says."""

    def __init__(
        self, camera: Camera, pattern: ReflectorPattern, options: AcquisitionOptions
    ) -> None:
        self._given = camera, pattern, options.blur_px
        self._sigmas = options.size_sigma, options.blur_sigma
        self.fitted_note: str | None = None  # by `fit_dots`, whose diameter is used
        self.clear()

    def clear(self) -> None:
        """Forget the readings."""
        self._range_m, self._sigma = math.inf, 0.0
        self._steps: list[float] = []

    @property
    def note(self) -> str | None:
        """What is different, in words; None where nothing is sure to be."""
        if self.fitted_note or len(self._steps) < _FEWEST:
            return self.fitted_note
        step = sum(self._steps) / len(self._steps)
        sure = abs(step) > max(_REPORTED_DIAMETER, _REPORTED_SIGMA * self._sigma)
        return _of_diameter(math.exp(step)) if sure else None

    def take(self, pose: Pose, spots: SpotTable, names: tuple[str | None, ...]) -> None:
        """Measure the dots of a reading, unless those of nearer readings were measured.

        A blur that differs looks like a diameter that does: the more, the more blurred a dot is.
        """
        camera, pattern, blur_px = self._given
        far = float(np.linalg.norm(pose.translation_m))
        if far < NEARER * self._range_m:
            self.clear()
            self._range_m = far
        if len(self._steps) >= _READINGS or NEARER * far > self._range_m:
            return
        whole = spots.saturated_px < 1.0
        rows = [k for k, name in enumerate(names) if name is not None and whole[k]]
        if not rows:
            return
        which = np.array([pattern.names.index(str(names[k])) for k in rows])
        step, share = _size_error(camera, pattern, blur_px, pose, which, spots.size_px[rows])
        if share < _BLURRED:
            size, blur = self._sigmas
            of_disc = 1.0 - share * share
            self._steps.append(step / of_disc)
            self._sigma = math.hypot(share * share * blur, size / math.sqrt(len(rows))) / of_disc
