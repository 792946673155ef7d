"""Where the windows are, the pose from their spots, and what else these spots could mean."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.background import Background
from rendezview.sensors.beacons.detect.cover import compare_spots
from rendezview.sensors.beacons.detect.difference import LitDark, ThresholdOptions
from rendezview.sensors.beacons.detect.discs import camera_numbers
from rendezview.sensors.beacons.detect.lens_scale import LensScale
from rendezview.sensors.beacons.detect.rolling_shutter import at_middle_row
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS, COVER, SIGMA, X
from rendezview.sensors.beacons.detect.spots import SpotTable, recentre
from rendezview.sensors.beacons.match.acquisition_options import Acquisition, AcquisitionOptions
from rendezview.sensors.beacons.match.choice import FEW
from rendezview.sensors.beacons.match.judgement import least_facing
from rendezview.sensors.beacons.match.matching import expect_spots
from rendezview.sensors.beacons.match.mirrored_pose import mirror
from rendezview.sensors.beacons.pose.refinement import Refined, SpotFit, loose_px
from rendezview.sensors.beacons.track import Branch, Track, TrackingOptions
from rendezview.sensors.beacons.windows import VISIBLE, place_windows, read_windows, window_noise

Ints = npt.NDArray[np.int64]

_SAME_RAD = 0.02  # rad: poses nearer than this, or than 4 σ, are one. Source: by construction
_CONTINUITY = 3.0  # the nearer of two poses to the last, by this factor. Source: by construction


class WindowFit:
    """Least squares on the spots of one constellation in one camera."""

    def __init__(
        self,
        camera: Camera,
        constellation: ReflectorPattern,
        acquisition: AcquisitionOptions,
        tracking: TrackingOptions,
        background: Background,
    ) -> None:
        self.camera, self.options, self.constellation = camera, tracking, constellation
        self._blur_px = acquisition.blur_px
        self._margin = acquisition.pose_margin
        self._least_cosine = acquisition.least_cosine
        self._lens = camera_numbers(camera, acquisition.blur_px)
        self.solve = SpotFit(camera, constellation, self._blur_px, tracking.floor_px).solve
        self._lens_scale = LensScale(camera, acquisition.blur_px)
        self._background = background  # of the last whole picture
        n = len(constellation)  # of the last reading's windows:
        self.expected, self.table = np.empty((n, 3)), np.empty((n, COLUMNS))
        self.rival = np.empty((n, COLUMNS))
        self.outcome = np.zeros(n, np.int64)
        self.half, self._level = np.empty(n), np.empty(n)
        self.light = np.zeros(n)  # χ² of sizes and brightnesses

    def look(
        self, time_s: float, track: Track, push: Array | None, frames: LitDark,
        threshold: ThresholdOptions,
    ) -> float:  # fmt: skip
        """Read all windows into ``expected``, ``table`` and ``outcome``; the noise of a pixel.

        ``push`` (6,) is the target's acceleration, `checked_acceleration`.
        """
        self._place(time_s, track, push, threshold)
        dark = frames.dark_or_nothing
        noise = window_noise(frames.lit, dark, self.expected, self.half)
        noise = track.noise if noise < 0.0 else noise
        read_windows(
            frames.lit, dark, self.expected, self.half, self._level, noise, self.table, self.rival,
            self.outcome,
        )  # fmt: skip
        seen = self.outcome == VISIBLE
        rows = self.table[seen]
        recentre(rows, noise, threshold.centroid)
        self._background.hidden.widen(rows)
        which = np.flatnonzero(seen)
        cover, unsure, self.light[which] = self.compare(rows, which, track.pose, track)
        rows[:, SIGMA], rows[:, COVER] = np.sqrt(rows[:, SIGMA] ** 2 + cover**2 + unsure**2), cover
        if self.options.readout_s:
            step_s, height = time_s - track.time_s, self.camera.height
            at_middle_row(rows, track.places[seen], step_s, self.options.readout_s, height)
        self.table[seen] = rows
        return noise

    def compare(
        self, rows: Array, which: Ints, pose: Pose, track: Track
    ) -> tuple[Array, Array, Array]:
        """`compare_spots` of this camera."""
        return compare_spots(
            rows, self.constellation, which, pose, self.camera.fx, self._blur_px,
            self._lens_scale.at(rows[:, :2]), track.brightness, track.aged,
        )  # fmt: skip

    def light_of(self, found: Acquisition, spots: SpotTable, track: Track | None) -> Array:
        """(K,) χ² of the light of the spots of a find beside what is known of the reflectors."""
        assert found.refined is not None
        assert found.reflectors is not None
        if track is None:
            return np.zeros(len(found.reflectors))
        pose, rows = found.refined.camera_from_target, spots.table[found.spot_indices]
        return self.compare(rows, found.reflectors, pose, track)[2]

    def at_one_time(
        self, refined: Refined, table: Array, before: Array, step_s: float
    ) -> Refined | None:
        """The pose of the table of a first find; ``before`` is that of the reading before."""
        if not self.options.readout_s:
            return refined
        readout_s, height = self.options.readout_s, self.camera.height
        at_middle_row(table, before[:, :2], step_s, readout_s, height, before_is_raw=True)
        seen = np.flatnonzero(np.isfinite(table[:, 0]))
        return self.solve(refined.camera_from_target, table, seen)

    def with_rivals(self, track: Track, seen: Ints) -> Iterator[tuple[Refined, Array]]:
        """Poses of few spots with the next best of one window, and (K,) χ² of their light."""
        for k in seen if len(seen) <= FEW else ():
            if math.isfinite(self.rival[k, X]):
                table = self.table.copy()
                table[k] = self.rival[k]
                refined = self.solve(track.pose, table, seen)
                if refined is not None:
                    yield refined, self.compare(table[seen], seen, track.pose, track)[2]

    def without_strangers(
        self, start: Pose, refined: Refined, table: Array, seen: Ints
    ) -> tuple[Refined | None, Ints]:
        """Drop the spot that fits worst for as long as one is out of the gate.

        No pose where four or fewer would be left: they may have their neighbours' names.
        """
        while True:
            off = np.abs(refined.residuals_px).max(axis=1) / self._sigma(refined, table, seen)
            if off.max() < self.options.gate_sigma:
                return refined, seen
            seen = np.delete(seen, off.argmax())
            fewer = self.solve(start, table, seen) if len(seen) > FEW else None
            if fewer is None:
                return None, seen[:0]
            refined = fewer

    def branch(self, track: Track, refined: Refined, table: Array, seen: Ints) -> Branch:
        """Whether the spots, or the motion, tell the pose from the mirrored one beside it."""
        pattern, pose = self.constellation, refined.camera_from_target
        mirrored = mirror(pose, pattern, seen)
        facing = least_facing(
            mirrored.rotation.copy(), mirrored.translation_m.copy(),
            pattern.positions_m[seen], pattern.normals[seen],
        )  # fmt: skip
        if facing < self._least_cosine:
            return Branch.SURE
        limit = max(_SAME_RAD, 4.0 * math.sqrt(float(np.trace(refined.covariance[:3, :3]))))
        if mirrored.angle_to(pose) < limit:
            return Branch.MERGED
        other = self.solve(mirrored, table, seen)
        if other is None or other.camera_from_target.angle_to(pose) < limit:
            return Branch.SURE
        if self._cost(other, table, seen) - self._cost(refined, table, seen) > self._margin:
            return Branch.SURE
        step = pose.angle_to(track.pose)
        continuous = other.camera_from_target.angle_to(track.pose) > _CONTINUITY * step
        return Branch.SURE if continuous and track.branch is Branch.SURE else Branch.OPEN

    def _cost(self, refined: Refined, table: Array, seen: Ints) -> float:
        sigma = self._sigma(refined, table, seen)
        return float(np.sum((refined.residuals_px / sigma[:, None]) ** 2))

    def _sigma(self, refined: Refined, table: Array, seen: Ints) -> Array:
        """(K,) σ of the spots' numbers at a pose, px."""
        spots = np.hypot(table[seen, SIGMA], self.options.floor_px)
        away = loose_px(self.constellation, refined, seen, self.camera.fx)
        return np.asarray(np.hypot(spots, away))

    def _place(
        self, time_s: float, track: Track, push: Array | None, threshold: ThresholdOptions
    ) -> None:
        """Where spots are expected (N, 3), half widths (N,) and thresholds (N,)."""
        expected = self.expected
        options = self.options
        self._show(track.pose, expected)
        step, span = time_s - track.time_s, track.time_s - track.before_s
        if push is not None:
            moved, still = np.empty_like(expected), expected.copy()
            self._show(track.pose.perturbed(0.5 * step * (step + span) * push), moved)
            expected[:, :2] += moved[:, :2] - still[:, :2]
        least = max(threshold.noise_factor * 0.7 * track.noise, threshold.least_grey)
        place_windows(
            expected, track.places, track.before, track.brightness, track.aged,
            step / span if span > 0.0 else 0.0, track.misses,
            (options.window_sizes, options.window_px, options.coasting_px, options.window_share,
             least),
            self.half, self._level,
        )  # fmt: skip

    def _show(self, pose: Pose, out: Array) -> None:
        """(N, 3) place and size of every reflector at a pose; NaN where it is not visible."""
        pattern = self.constellation
        expect_spots(
            self._lens, pattern.positions_m, pattern.normals, pattern.diameters_m,
            pose.rotation.copy(), pose.translation_m.copy(), self.camera.fx, self._blur_px, out,
        )  # fmt: skip
        self._lens_scale.distort(out)

    def missing(self, names: tuple[str, ...]) -> list[str]:
        """Reflectors that were expected in the picture, other than ``names``."""
        shown = np.isfinite(self.expected[:, 0])
        pairs = zip(self.constellation.names, shown, strict=True)
        return [name for name, expected in pairs if expected and name not in names]

    def misses(self, seen: Ints) -> bool:
        """Whether a reflector is not visible that is expected well inside the picture."""
        width, height = self.camera.width - 1, self.camera.height - 1
        visible = seen.tolist()
        for k, (x, y, size) in enumerate(self.expected.tolist()):
            margin = 3.0 * size + self.options.window_px
            inside = margin < x < width - margin and margin < y < height - margin
            if inside and k not in visible:
                return True
        return False
