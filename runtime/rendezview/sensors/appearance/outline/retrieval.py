"""Retrieval of starting poses: one signature against every view of the model at every roll."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose, minimal_rotation
from rendezview.sensors.appearance.model.shadowed_silhouettes import (
    READING_UNIT,
    SHADOWED_BINS,
    ShadowedSilhouettes,
)
from rendezview.sensors.appearance.model.signature import (
    BORESIGHT,
    UNIT,
    Readings,
    Signature,
    quantised,
    radial_maxima,
    rebinning,
    rolled,
    spokes_of,
    twist,
)
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.outline.placement import range_from_area, turned_offsets
from rendezview.sensors.appearance.outline.similarity import Catalogue, spread_out

# rad; the catalogue's Suns are 32° apart.
_SUN_REACH_RAD = np.deg2rad(30.0)  # Source: by construction
# rad; views closer than this, at the same roll, lead to the same pose. Source: spacing of the
# nodes' views
SAME_VIEW_RAD = np.deg2rad(7.0)
# Of the mean radius: perspective and the spacing of the views. Source: fixed with the fit of
# error_model.json
_OVERSHOOT_TOLERANCE = 0.06


class Retrieval:
    """All views of one model, prepared for the comparison with a signature."""

    def __init__(self, model: ViewModel) -> None:
        self.model = model
        self._readings = model.views.readings.astype(np.float32)
        self._rebinning = rebinning(model.bins, SHADOWED_BINS)
        self._whole = Catalogue(self._coarse(self._readings))
        self._directions = model.lattice.nodes.copy()
        self._shadowed: Catalogue | None = None
        if model.lit is not None:
            readings = model.lit.readings.astype(np.float32) * np.float32(READING_UNIT)
            self._shadowed = Catalogue(readings)

    def of(
        self, signature: Signature, most: int, sun_camera: Array | None = None
    ) -> tuple[Array, Array]:
        """Poses whose views are most similar to the signature, spread out.

        Half of them come from whole silhouettes, half from shadowed silhouettes; all from whole
        ones where the model has no others.

        Args:
            most: how many at most.
            sun_camera: (3,) unit, towards the Sun, camera frame, if it is known: then only
                shadowed silhouettes under this Sun are compared.

        Returns:
            Rotations (K, 3, 3) camera_from_target and the view centre (K, 3), camera frame; the
            most similar of both kinds first, in turns.
        """
        readings = self._coarse(signature.readings)
        share = most if self._shadowed is None else most // 2
        whole = self._of_whole(signature, readings, share)
        if self._shadowed is None or self.model.lit is None:
            return whole
        shadowed = self._of_shadowed(
            self._shadowed, self.model.lit, signature, readings, most - share, sun_camera
        )
        in_turns = np.argsort(
            np.concatenate([np.arange(len(p[0])) for p in (whole, shadowed)]), kind="stable"
        )
        return (
            np.concatenate([whole[0], shadowed[0]])[in_turns],
            np.concatenate([whole[1], shadowed[1]])[in_turns],
        )

    def _of_whole(self, signature: Signature, readings: Readings, most: int) -> tuple[Array, Array]:
        """Poses of the most similar whole silhouettes."""
        views, shifts = self._whole.most_similar(readings)
        chosen = self._spread(views, shifts, most)
        views, rolls = views[chosen], self._rolls(shifts[chosen])
        data = self.model.views
        range_m = range_from_area(
            self.model, data.area_m2[views], data.area_slope[views], signature.area_sr
        )
        attitudes, offsets_m = data.centred_from_target[views], data.offset_m[views]
        return _placed(signature, attitudes, offsets_m, range_m, rolls)

    def _of_shadowed(
        self,
        catalogue: Catalogue,
        shadowed: ShadowedSilhouettes,
        signature: Signature,
        readings: Readings,
        most: int,
        sun_camera: Array | None,
    ) -> tuple[Array, Array]:
        """Poses of the most similar shadowed silhouettes, under the Sun if it is known."""
        entries, shifts = catalogue.most_similar(readings)
        if sun_camera is not None:
            sun = signature.centred_from_camera @ sun_camera
            under_sun = _under_sun(shadowed, entries, self._rolls(shifts), sun)
            entries, shifts = entries[under_sun], shifts[under_sun]
        chosen = self._spread(shadowed.view[entries].astype(np.intp), shifts, most)
        entries, rolls = entries[chosen], self._rolls(shifts[chosen])
        attitudes = np.zeros((0, 3, 3))
        if len(entries):
            attitudes = _attitudes(shadowed.quat_wxyz[entries]).as_matrix()
        range_m = np.sqrt(shadowed.area_m2[entries] / signature.area_sr)
        offsets_m = shadowed.offset_m[entries].astype(np.float64)
        return _placed(signature, attitudes, offsets_m, range_m, rolls)

    def _rolls(self, shifts: npt.NDArray[np.intp]) -> Array:
        """Roll of a view that is shifted by some bins, rad."""
        return np.asarray(-2.0 * np.pi / SHADOWED_BINS * shifts)

    def _spread(
        self, views: npt.NDArray[np.intp], shifts: npt.NDArray[np.intp], most: int
    ) -> npt.NDArray[np.intp]:
        cosine = float(np.cos(SAME_VIEW_RAD))
        return np.asarray(spread_out(views, shifts, self._directions, cosine, SHADOWED_BINS, most))

    def overshoot(self, outlines: list[Array], pose: Pose) -> float:
        """How far outlines reach beyond the silhouette that a pose predicts.

        Mean over the bins, in mean radii of the silhouette: 0 where all outlines lie inside.
        Parts in shadow do not count, so a target half in shadow has none.

        Args:
            outlines: (M, 3) rays each, camera frame.
        """
        model, views = self.model, self.model.views
        centre = pose.apply(model.centre_m)
        range_m = float(np.linalg.norm(centre))
        turn = minimal_rotation(centre, BORESIGHT)
        attitude = turn @ pose.rotation
        view = int(np.argmax(self._directions @ -attitude[2]))
        roll = float(twist(attitude, views.centred_from_target[view]))
        offset = turned_offsets(views.offset_m[view], roll)
        centroid = turn.T @ np.array([-offset[0] / range_m, -offset[1] / range_m, 1.0])
        centred_from_camera = minimal_rotation(centroid, BORESIGHT)
        maxima = np.zeros(model.bins)
        for rays in outlines:
            radial_maxima(rays, centred_from_camera, spokes_of(model.bins), maxima)
        loom = 1.0 + views.area_slope[view] * (model.sphere_radius_m / range_m - 1.0)
        area_sr = float(views.area_m2[view] * max(loom, 0.1)) / range_m**2
        seen = rolled(quantised(maxima, UNIT / np.sqrt(area_sr), model.smooth_bins), roll)
        expected = self._readings[view]
        mean = float(expected.mean())
        beyond = np.maximum(seen - expected - _OVERSHOOT_TOLERANCE * mean, 0.0)
        return float(beyond.mean()) / mean

    def _coarse(self, readings: Readings) -> Readings:
        return np.asarray(readings @ self._rebinning, dtype=np.float32)


def _attitudes(quat_wxyz: npt.NDArray[np.float32]) -> Rotation:
    return Rotation.from_quat(quat_wxyz[:, [1, 2, 3, 0]])


def _under_sun(
    shadowed: ShadowedSilhouettes, entries: npt.NDArray[np.intp], rolls_rad: Array, sun: Array
) -> npt.NDArray[np.bool_]:
    """(K,) which shadowed silhouettes, at their rolls, belong to a Sun near the given one.

    ``sun`` (3,) is the direction of the Sun from the camera turned to the centroid.
    """
    c, s = np.cos(rolls_rad), np.sin(rolls_rad)
    unrolled = np.stack([c * sun[0] + s * sun[1], c * sun[1] - s * sun[0], sun[2] + 0.0 * c], 1)
    there = _attitudes(shadowed.quat_wxyz[entries]).apply(unrolled, inverse=True)
    cosine = np.einsum("ij,ij->i", there, shadowed.suns[shadowed.sun[entries]])
    return np.asarray(cosine > np.cos(_SUN_REACH_RAD))


def _placed(
    signature: Signature, attitudes: Array, offsets_m: Array, range_m: Array, rolls_rad: Array
) -> tuple[Array, Array]:
    """Rotations and view centres of centred attitudes (K, 3, 3) at rolls and ranges (K,)."""
    c, s = np.cos(rolls_rad), np.sin(rolls_rad)
    about = np.zeros((len(c), 3, 3))
    about[:, 0, 0], about[:, 0, 1], about[:, 1, 0], about[:, 1, 1] = c, -s, s, c
    about[:, 2, 2] = 1.0
    offsets = turned_offsets(offsets_m, rolls_rad) / range_m[:, None]
    line = np.concatenate([offsets, np.ones((len(c), 1))], axis=1)
    line *= (range_m / np.linalg.norm(line, axis=1))[:, None]
    camera_from_centred = signature.centred_from_camera.T
    return camera_from_centred @ about @ attitudes, line @ camera_from_centred.T
