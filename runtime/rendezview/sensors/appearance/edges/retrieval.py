"""First poses without a prior: every view of the model at every roll against one signature."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import fft
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose, minimal_rotation
from rendezview.sensors.appearance.edges.shadowed_silhouettes import LIT_BINS, READING_UNIT
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.outline.placement import range_from_area
from rendezview.sensors.appearance.outline.signature import (
    UNIT,
    Readings,
    Signature,
    quantised,
    radial_maxima,
    rolled,
    spokes_of,
    twist,
)

_BEST = 2000  # likenesses that are looked through
_HARMONICS = 20
_CORRELATED = 2000  # entries at most, of a large catalogue
_SAMPLED = 17  # one of so many values; no divisor of a number of bins
_SUN_REACH_RAD = np.deg2rad(30.0)  # the catalogue's Suns are 32° apart
_APART_RAD = np.deg2rad(7.0)  # views nearer than this, at the same roll, are one hypothesis
_SAME_ROLL_BINS = 3
_EXCESS_TOLERANCE = 0.06  # of the mean radius: perspective and the spacing of the views
_BORESIGHT = np.array([0.0, 0.0, 1.0])


class _Catalogue:
    """Signatures with their spectra: the likeness of one to all, at every roll at once."""

    def __init__(self, readings: Readings) -> None:
        self.bins = readings.shape[1]
        self._spectra = np.conj(fft.rfft(readings, axis=1))
        self._squares = np.sum(readings**2, axis=1)
        # What a roll leaves unchanged: the sizes of the harmonics.
        self._sizes = np.ascontiguousarray(np.abs(self._spectra[:, :_HARMONICS]))

    def most_alike(self, readings: Readings) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Entries and shifts in bins, least distance first, at most ``_BEST``.

        By circular correlation, of the entries whose harmonics are of the right size.
        """
        spectrum = fft.rfft(readings)
        entries = np.arange(len(self._sizes))
        if len(entries) > _CORRELATED:
            sizes = np.abs(spectrum[:_HARMONICS]).astype(np.float32)
            entries = least(_squared_distances(self._sizes, sizes), _CORRELATED)
        correlation = fft.irfft(spectrum * self._spectra[entries], n=self.bins, axis=1)
        distance = (self._squares[entries][:, None] - 2.0 * correlation).ravel()
        first = least(distance, _BEST)
        first = first[np.argsort(distance[first], kind="stable")]
        rows, shifts = np.divmod(first, self.bins)
        return entries[rows], shifts


def least(values: npt.NDArray[np.float32], count: int) -> npt.NDArray[np.intp]:
    """Places, ascending, of the ``count`` least of many values (K,); all where there are fewer.

    A sample of the values tells below which bound nearly all of them need no further look.
    """
    if count >= len(values):
        return np.arange(len(values))
    sample, place = values[::_SAMPLED], count // _SAMPLED * 3 // 2 + _SAMPLED
    bound = np.partition(sample, place)[place] if place < len(sample) else np.inf
    few = np.flatnonzero(values <= bound)
    if len(few) < count:  # which so large a sample hardly allows
        few = np.arange(len(values))
    return np.sort(few[np.argpartition(values[few], count - 1)[:count]])


class Retrieval:
    """All views of one model, ready to be compared with a signature."""

    def __init__(self, model: ViewModel) -> None:
        self.model = model
        self._readings = model.views.readings.astype(np.float32)
        self._bins = LIT_BINS if model.bins % LIT_BINS == 0 else model.bins
        self._whole = _Catalogue(self._coarse(self._readings))
        self._directions = np.ascontiguousarray(model.lattice.nodes)
        self._lit: _Catalogue | None = None
        if model.lit is not None and self._bins == LIT_BINS:
            self._lit = _Catalogue(model.lit.readings.astype(np.float32) * np.float32(READING_UNIT))

    def of(
        self, signature: Signature, most: int, sun_camera: Array | None = None
    ) -> tuple[Array, Array]:
        """Poses whose views are most alike the signature, spread out.

        Half of them from whole silhouettes, half from those that the Sun lights in part;
        all from the former where the model has no others.

        Args:
            most: how many at most.
            sun_camera: (3,) unit, towards the Sun, camera frame, if it is known: then only
                parts that this Sun can light are compared.

        Returns:
            Rotations (K, 3, 3) camera_from_target and the view centre (K, 3), camera frame; the
            most alike of both kinds first, in turns.
        """
        readings = self._coarse(signature.readings)
        step = 2.0 * np.pi / self._bins
        cosine = float(np.cos(_APART_RAD))
        views, shifts = self._whole.most_alike(readings)
        share = most if self._lit is None else most // 2
        chosen = _spread(views, shifts, self._directions, cosine, self._bins, share)
        chosen_views, rolls = views[chosen], -step * shifts[chosen]
        data = self.model.views
        range_m = range_from_area(
            self.model, data.area_m2[chosen_views], data.area_slope[chosen_views], signature.area_sr
        )
        whole = _placed(
            signature, data.centred_from_target[chosen_views], data.offset_m[chosen_views], range_m,
            rolls,
        )  # fmt: skip
        lit = self.model.lit
        if self._lit is None or lit is None:
            return whole
        entries, shifts = self._lit.most_alike(readings)
        if sun_camera is not None:
            entries, shifts = self._under(entries, shifts, signature, sun_camera)
        seen = lit.view[entries].astype(np.intp)
        chosen = _spread(seen, shifts, self._directions, cosine, self._bins, most - share)
        entries, rolls = entries[chosen], -step * shifts[chosen]
        attitudes = np.zeros((0, 3, 3))
        if len(entries):
            attitudes = Rotation.from_quat(lit.quat_wxyz[entries][:, [1, 2, 3, 0]]).as_matrix()
        part = _placed(
            signature, attitudes, lit.offset_m[entries].astype(np.float64),
            np.sqrt(lit.area_m2[entries] / signature.area_sr), rolls,
        )  # fmt: skip
        turns = np.argsort(
            np.concatenate([np.arange(len(p[0])) for p in (whole, part)]), kind="stable"
        )
        return (
            np.concatenate([whole[0], part[0]])[turns],
            np.concatenate([whole[1], part[1]])[turns],
        )

    def _under(
        self,
        entries: npt.NDArray[np.intp],
        shifts: npt.NDArray[np.intp],
        signature: Signature,
        sun_camera: Array,
    ) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Of lit views at rolls those whose Sun stands where it is."""
        lit = self.model.lit
        assert lit is not None
        sun = signature.centred_from_camera @ sun_camera
        roll = -2.0 * np.pi / self._bins * shifts
        c, s = np.cos(roll), np.sin(roll)
        unrolled = np.stack([c * sun[0] + s * sun[1], c * sun[1] - s * sun[0], sun[2] + 0.0 * c], 1)
        attitude = Rotation.from_quat(lit.quat_wxyz[entries][:, [1, 2, 3, 0]].astype(np.float64))
        there = attitude.apply(unrolled, inverse=True)
        good = np.einsum("ij,ij->i", there, lit.suns[lit.sun[entries]]) > np.cos(_SUN_REACH_RAD)
        return entries[good], shifts[good]

    def excess(self, outlines: list[Array], pose: Pose) -> float:
        """How far outlines reach beyond the silhouette that a pose predicts.

        Mean over the bins, in mean radii of the silhouette: 0 where everything that is seen
        lies inside. What is not lit says nothing, so a target half in shadow has none.

        Args:
            outlines: (M, 3) rays each, camera frame.
        """
        model, views = self.model, self.model.views
        centre = pose.apply(model.centre_m)
        range_m = float(np.linalg.norm(centre))
        turn = minimal_rotation(centre, _BORESIGHT)
        attitude = turn @ pose.rotation
        view = int(np.argmax(self._directions @ -attitude[2]))
        roll = float(twist(attitude, views.centred_from_target[view]))
        offset = _rolled_offset(views.offset_m[view], roll)
        centroid = turn.T @ np.array([-offset[0] / range_m, -offset[1] / range_m, 1.0])
        centred_from_camera = minimal_rotation(centroid, _BORESIGHT)
        maxima = np.zeros(model.bins)
        for rays in outlines:
            radial_maxima(rays, centred_from_camera, spokes_of(model.bins), maxima)
        loom = 1.0 + views.area_slope[view] * (model.sphere_radius_m / range_m - 1.0)
        area_sr = float(views.area_m2[view] * max(loom, 0.1)) / range_m**2
        seen = rolled(quantised(maxima, UNIT / np.sqrt(area_sr), model.smooth_bins), roll)
        expected = self._readings[view]
        mean = float(expected.mean())
        beyond = np.maximum(seen - expected - _EXCESS_TOLERANCE * mean, 0.0)
        return float(beyond.mean()) / mean

    def _coarse(self, readings: Readings) -> Readings:
        groups = readings.reshape(*readings.shape[:-1], self._bins, -1)
        return np.asarray(groups.mean(axis=-1), dtype=np.float32)


def _placed(
    signature: Signature, attitudes: Array, offsets_m: Array, range_m: Array, rolls_rad: Array
) -> tuple[Array, Array]:
    """Rotations and view centres of centred attitudes (K, 3, 3) at rolls and ranges (K,)."""
    c, s = np.cos(rolls_rad), np.sin(rolls_rad)
    about = np.zeros((len(c), 3, 3))
    about[:, 0, 0], about[:, 0, 1], about[:, 1, 0], about[:, 1, 1] = c, -s, s, c
    about[:, 2, 2] = 1.0
    x, y = offsets_m[:, 0], offsets_m[:, 1]
    line = np.stack([(c * x - s * y) / range_m, (s * x + c * y) / range_m, np.ones(len(c))], axis=1)
    line *= (range_m / np.linalg.norm(line, axis=1))[:, None]
    camera_from_centred = signature.centred_from_camera.T
    return camera_from_centred @ about @ attitudes, line @ camera_from_centred.T


def _rolled_offset(offset_m: Array, roll_rad: float) -> Array:
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    return np.array([c * offset_m[0] - s * offset_m[1], s * offset_m[0] + c * offset_m[1]])


@njit(cache=True, nogil=True, fastmath=True)
def _squared_distances(rows, one):  # type: ignore[no-untyped-def]
    """Of each of some vectors (K, N) to one (N,)."""
    squares = np.empty(rows.shape[0], dtype=np.float32)
    for k in range(rows.shape[0]):
        total = np.float32(0.0)
        for j in range(one.shape[0]):
            apart = rows[k, j] - one[j]
            total += apart * apart
        squares[k] = total
    return squares


@njit(cache=True, nogil=True)
def _spread(  # type: ignore[no-untyped-def]
    views, shifts, directions, cosine, bins, most
):
    """The first of some views and shifts, in order, that are not near one before."""
    chosen = np.empty(most, dtype=np.intp)
    count = 0
    for k in range(views.shape[0]):
        near = False
        a = directions[views[k]]
        for j in range(count):
            b = directions[views[chosen[j]]]
            if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > cosine:
                apart = abs(shifts[k] - shifts[chosen[j]])
                if min(apart, bins - apart) <= _SAME_ROLL_BINS:
                    near = True
                    break
        if not near:
            chosen[count] = k
            count += 1
            if count == most:
                break
    return chosen[:count]
