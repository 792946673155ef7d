"""The reflector sensor: acquires, tracks and reacquires; one observation a pair of pictures."""

from __future__ import annotations

import threading
import time

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.observation import Status
from rendezview.sensors.reflectors.acquisition import (
    Acquirer,
    Acquisition,
    AcquisitionOptions,
    merged,
)
from rendezview.sensors.reflectors.difference import LitDark, ThresholdOptions
from rendezview.sensors.reflectors.discs import camera_numbers
from rendezview.sensors.reflectors.matching import expect_spots
from rendezview.sensors.reflectors.observation import ReflectorObservation
from rendezview.sensors.reflectors.pattern import Face, ReflectorPattern
from rendezview.sensors.reflectors.rates import RateEstimator
from rendezview.sensors.reflectors.refinement import Refined, adjust, solve_spots
from rendezview.sensors.reflectors.spots import COLUMNS, SIGMA, SpotTable, find_spots
from rendezview.sensors.reflectors.track import Track, TrackingOptions, checked_acceleration
from rendezview.sensors.reflectors.windows import (
    VISIBLE,
    carry,
    place_windows,
    read_windows,
    window_noise,
)


class ReflectorSensor:
    """Follows one target with one camera, in order of time.

    Threads may share an instance: their calls run one after the other.

    Args:
        camera: of the pictures.
        patterns: the groups of reflectors, as `patterns_of` gives them. All are one rigid target:
            all visible reflectors make the pose, which is the hand-over from the far
            target to the near one; the six numbers are of the first completely visible group.
        threshold, acquisition, tracking: options.
    """

    def __init__(
        self,
        camera: Camera,
        patterns: list[ReflectorPattern],
        *,
        threshold: ThresholdOptions | None = None,
        acquisition: AcquisitionOptions | None = None,
        tracking: TrackingOptions | None = None,
    ) -> None:
        if not patterns:
            raise RendezviewError("no reflectors to look for: name a group of the target file")
        self.camera = camera
        self.patterns = patterns
        self.constellation = merged(patterns)
        self.threshold = threshold or ThresholdOptions()
        self.tracking = tracking or TrackingOptions()
        self.acquirer = Acquirer(camera, patterns, acquisition)
        self._faces = {pattern.name: Face.of(pattern) for pattern in patterns}
        self._rates = RateEstimator(self.tracking.rate_readings)
        self._lens = camera_numbers(camera, self.acquirer.options.blur_px)
        self._track: Track | None = None
        self._unconfirmed: tuple[float, Pose, Array] | None = None
        self._last_s = -np.inf
        self._lock = threading.Lock()
        n = len(self.constellation)
        self._expected, self._table = np.empty((n, 3)), np.empty((n, COLUMNS))
        self._outcome = np.zeros(n, np.int64)
        self._half, self._level = np.empty(n), np.empty(n)
        self._never, self._dim = np.zeros(n, np.int64), np.full(n, np.nan)
        self._nowhere = np.full((n, 2), np.nan)
        self._group_of = [pattern.name for pattern in patterns for _ in pattern.names]
        self._centre = self.constellation.centre_m
        self._arms = self.constellation.positions_m - self._centre

    @property
    def is_tracking(self) -> bool:
        """Whether the next reading looks into windows only."""
        return self._track is not None and self._track.misses <= self.tracking.coast

    def start(self, time_s: float, pose: Pose, *, roll_known: bool = True) -> None:
        """Begin to track from a pose of another camera or sensor."""
        n = len(self.constellation)
        nowhere = np.full((n, 2), np.nan)
        with self._lock:
            self._track = Track(
                time_s, pose, nowhere, nowhere.copy(), time_s, np.full(n, np.nan), 2.0,
                not roll_known, np.zeros((6, 6)), unseen=np.zeros(n, np.int64),
            )  # fmt: skip
            self._rates.clear()

    def update(
        self, time_s: float, frames: LitDark, acceleration: npt.ArrayLike | None = None
    ) -> ReflectorObservation:
        """Look at the next pair of pictures.

        Args:
            time_s: of the lit picture, later than the last.
            frames: the pictures.
            acceleration: (6,) of the target in the camera frame as the control system knows it,
                (angular rad/s², linear m/s²): moves the windows.

        Raises:
            ValueError: times do not rise, or the acceleration is not (6,) and finite.
            RendezviewError: the pictures are not the camera's.
        """
        push = None if acceleration is None else checked_acceleration(acceleration)
        frames.check(self.camera)
        with self._lock:
            if not (np.isfinite(time_s) and time_s > self._last_s):
                raise ValueError(
                    f"readings must come in order of time: {time_s} after {self._last_s}"
                )
            self._last_s = time_s
            if self.is_tracking:
                return self._follow(time_s, frames, push)
            return self._acquire(time_s, frames)

    # --- acquisition

    def _acquire(self, time_s: float, frames: LitDark) -> ReflectorObservation:
        prior = None
        if self._track is not None:
            if self._track.misses <= self.tracking.memory:
                prior = self._track.pose
            else:
                self._track = None
        begin = time.perf_counter()
        spots = find_spots(frames, self.threshold)
        middle = time.perf_counter()
        found = self.acquirer.acquire(spots, prior)
        end = time.perf_counter()
        stage_ms = {"spots": 1e3 * (middle - begin), "triplets": 1e3 * (end - middle)}
        if found.refined is None:
            if self._track is not None:
                self._track.misses += 1
            self._unconfirmed = None
            return ReflectorObservation(
                found.status, found.reason, time_s=time_s, spots=spots,
                reflectors=(None,) * len(spots), stage_ms=stage_ms,
            )  # fmt: skip
        assert found.reflectors is not None
        assert found.spot_indices is not None
        names: list[str | None] = [None] * len(spots)
        for reflector, spot in zip(found.reflectors, found.spot_indices, strict=True):
            names[spot] = self.constellation.names[reflector]
        pose = found.refined.camera_from_target
        if self.tracking.confirm and prior is None and not self._agrees(time_s, pose):
            self._unconfirmed = (time_s, pose, self._table_of(found, spots))
            return ReflectorObservation(
                Status.UNCONFIRMED, "found for the first time: the next reading must agree",
                time_s=time_s, spots=spots, reflectors=tuple(names), group=found.group,
                stage_ms=stage_ms,
            )  # fmt: skip
        ambiguous = found.roll_ambiguous
        if prior is not None and self._track is not None:  # it stays as well known as it was
            ambiguous = self._track.roll_ambiguous and not self._resolves(found.reflectors)
        table = self._table_of(found, spots)
        self._remember(time_s, table, found.refined, 2.0, ambiguous)
        if self._unconfirmed is not None and self._track is not None:
            self._track.before_s, _, first = self._unconfirmed
            self._track.before = first[:, :2]
        self._unconfirmed = None
        return self._reading(
            time_s, found.refined, spots, tuple(names), found.group, stage_ms,
            ambiguous, tracked=False,
        )  # fmt: skip

    def _agrees(self, time_s: float, pose: Pose) -> bool:
        """Whether a second find is near the first: a tenth of the range, half a radian."""
        if self._unconfirmed is None:
            return False
        _, first, _ = self._unconfirmed
        where, was = pose.apply(self._centre), first.apply(self._centre)
        near = np.linalg.norm(where - was) < 0.1 * np.linalg.norm(was)
        return bool(near and np.trace(pose.rotation @ first.rotation.T) > 1.0 + 2.0 * np.cos(0.5))

    def _table_of(self, found: Acquisition, spots: SpotTable) -> Array:
        """(N, 19) the spot of every reflector, NaN where it has none."""
        table = np.full((len(self.constellation), COLUMNS), np.nan)
        table[found.reflectors] = spots.table[found.spot_indices]
        return table

    # --- tracking

    def _follow(self, time_s: float, frames: LitDark, push: Array | None) -> ReflectorObservation:
        track, options = self._track, self.tracking
        assert track is not None
        begin = time.perf_counter()
        expected, half, level = self._windows(time_s, track, push)
        dark = frames.dark_or_nothing
        noise = window_noise(frames.lit, dark, expected, half)
        noise = track.noise if noise < 0.0 else noise
        read_windows(
            frames.lit, dark, expected, half, level, noise,
            (options.size_limit, options.least_shape), self._table, self._outcome,
        )  # fmt: skip
        middle = time.perf_counter()
        seen = np.flatnonzero(self._outcome == VISIBLE)
        refined = self._solve(track, seen) if len(seen) >= 3 else None
        if refined is not None and len(seen) > 3:
            refined, seen = self._without_strangers(track, refined, seen)
        ended = time.perf_counter()
        stage_ms = {"windows": 1e3 * (middle - begin), "pose": 1e3 * (ended - middle)}
        names = tuple(self.constellation.names[k] for k in seen)
        spots = SpotTable(self._table[seen])
        self._outcome[:] = 0
        self._outcome[seen] = VISIBLE
        if refined is None and not np.isfinite(track.before).any():
            return self._acquire(
                time_s, frames
            )  # the motion is not known: windows are of little use
        if refined is None:
            return self._miss(time_s, track, seen, spots, names, stage_ms)
        table = self._table
        table[self._outcome != VISIBLE] = np.nan
        table = table.copy()
        ambiguous = track.roll_ambiguous and not self._resolves(seen)
        self._remember(time_s, table, refined, noise, ambiguous)
        return self._reading(time_s, refined, spots, names, None, stage_ms, ambiguous, tracked=True)

    def _windows(
        self, time_s: float, track: Track, push: Array | None
    ) -> tuple[Array, Array, Array]:
        """Where spots are expected (N, 3), half widths (N,) and thresholds (N,)."""
        options, expected = self.tracking, self._expected
        self._show(track.pose, expected)
        step, span = time_s - track.time_s, track.time_s - track.before_s
        if push is not None:
            moved, still = np.empty_like(expected), expected.copy()
            self._show(track.pose.perturbed(0.5 * step * (step + span) * push), moved)
            expected[:, :2] += moved[:, :2] - still[:, :2]
        least = max(self.threshold.noise_factor * 0.7 * track.noise, self.threshold.least_grey)
        place_windows(
            expected, track.places, track.before, track.brightness, track.unseen,
            step / span if span > 0.0 else 0.0, track.misses,
            (options.window_sizes, options.window_px, options.coasting_px, options.window_share,
             options.apart_sizes, least),
            self._half, self._level,
        )  # fmt: skip
        return expected, self._half, self._level

    def _show(self, pose: Pose, out: Array) -> None:
        """(N, 3) place and size of every reflector at a pose; NaN where it is not visible."""
        pattern = self.constellation
        expect_spots(
            self._lens, pattern.positions_m, pattern.normals, pattern.diameters_m,
            pose.rotation, pose.translation_m, self.camera.fx, self.acquirer.options.blur_px, out,
        )  # fmt: skip

    def _solve(self, track: Track, seen: npt.NDArray[np.int64]) -> Refined | None:
        """Least squares from the last pose."""
        rotation, translation = np.array(track.pose.rotation), np.empty(3)
        covariance, residuals = np.empty((6, 6)), np.empty((len(seen), 2))
        iterations = solve_spots(
            self._lens, self._arms, self.constellation.normals, self.constellation.diameters_m,
            self._centre, self._table, seen, self.tracking.floor_px,
            rotation, track.pose.translation_m, translation, covariance, residuals,
        )  # fmt: skip
        if iterations < 0:
            return None
        return Refined(Pose(rotation, translation), covariance, residuals, iterations, True)

    def _without_strangers(
        self, track: Track, refined: Refined, seen: npt.NDArray[np.int64]
    ) -> tuple[Refined | None, npt.NDArray[np.int64]]:
        """Drop the spot that fits worst for as long as one is out of the gate."""
        current: Refined | None = refined
        while current is not None and len(seen) > 3:
            sigma = np.sqrt(self._table[seen, SIGMA] ** 2 + self.tracking.floor_px**2)
            off = np.abs(current.residuals_px).max(axis=1) / sigma
            if off.max() < self.tracking.gate_sigma:
                break
            # The one without which the rest agree best.
            trials = []
            for k in range(len(seen)):
                rest = np.delete(seen, k)
                trial = self._solve(track, rest)
                if trial is not None:
                    cost = float(np.sum(trial.residuals_px**2))
                    trials.append((cost, k, trial))
            if not trials:
                return None, seen
            _, k, current = min(trials, key=lambda item: item[:2])
            seen = np.delete(seen, k)
        return current, seen

    def _miss(
        self,
        time_s: float,
        track: Track,
        seen: npt.NDArray[np.int64],
        spots: SpotTable,
        names: tuple[str, ...],
        stage_ms: dict[str, float],
    ) -> ReflectorObservation:
        track.misses += 1
        self._rates.clear()
        if len(seen) and track.misses <= self.tracking.coast:
            # Visible reflectors still move the windows of the others.
            places = np.full_like(track.places, np.nan)
            places[seen] = self._table[seen, :2]
            self._nudge(track, seen)
            track.before, track.before_s = track.places, track.time_s
            track.places, track.time_s = places, time_s
            track.unseen = np.where(np.isfinite(places[:, 0]), 0, track.unseen + 1)
        if len(seen):
            expected = zip(self.constellation.names, np.isfinite(self._expected[:, 0]), strict=True)
            lost = [name for name, visible in expected if visible and name not in names]
            return ReflectorObservation(
                Status.PARTIAL,
                f"{len(seen)} of the reflectors visible ({', '.join(names)}), which fixes no pose; "
                f"not visible: {', '.join(lost)}",
                time_s=time_s, spots=spots, reflectors=names, tracked=True, stage_ms=stage_ms,
            )  # fmt: skip
        return ReflectorObservation(
            Status.LOST,
            "no reflector where it was expected"
            + ("" if self.is_tracking else ": the whole picture is searched next"),
            time_s=time_s,
            tracked=True,
            stage_ms=stage_ms,
        )

    def _nudge(self, track: Track, seen: npt.NDArray[np.int64]) -> None:
        """Move the remembered pose by the least that brings it under the visible spots."""
        if not track.covariance.any():
            return
        rotation, shift = np.array(track.pose.rotation), track.pose.apply(self._centre)
        far = float(np.linalg.norm(shift))
        # The attitude may turn by 0.1 rad and the place move by 5 % meanwhile.
        prior = np.diag([1e2, 1e2, 1e2, *([400.0 / far**2] * 3)])
        covariance, residuals = np.empty((6, 6)), np.empty((len(seen), 2))
        iterations = adjust(
            self._lens, self._arms[seen], self.constellation.normals[seen],
            self.constellation.diameters_m[seen], np.ascontiguousarray(self._table[seen, :2]),
            np.full(len(seen), 0.1), prior, rotation, shift, covariance, residuals,
        )  # fmt: skip
        if iterations >= 0:
            track.pose = Pose(rotation, shift - rotation @ self._centre)

    # --- both

    def _resolves(self, seen: npt.NDArray[np.int64]) -> bool:
        """Whether reflectors of two groups are visible: their offset fixes the roll."""
        return len({self._group_of[k] for k in seen}) > 1

    def _remember(
        self, time_s: float, table: Array, refined: Refined, noise: float, ambiguous: bool
    ) -> None:
        last = self._track
        bright, unseen = np.empty(len(table)), np.empty(len(table), np.int64)
        if last is None:
            since, before, before_s = self._never, self._nowhere, time_s
        else:
            since, before, before_s = last.unseen, last.places, last.time_s
        if last is None or last.misses > self.tracking.coast:
            before, before_s = self._nowhere, time_s
            self._rates.clear()
        carry(table, self._dim if last is None else last.brightness, since, bright, unseen)
        self._track = Track(
            time_s, refined.camera_from_target, table[:, :2], before, before_s, bright, noise,
            ambiguous, refined.covariance, unseen=unseen,
        )  # fmt: skip

    def _reading(
        self,
        time_s: float,
        refined: Refined,
        spots: SpotTable,
        names: tuple[str | None, ...],
        group: str | None,
        stage_ms: dict[str, float],
        ambiguous: bool,
        tracked: bool,
    ) -> ReflectorObservation:
        begin = time.perf_counter()
        pose = refined.camera_from_target
        whole = next(
            (p for p in self.patterns if all(name in names for name in p.names)),
            next((p for p in self.patterns if p.name == group), self.patterns[0]),
        )
        six = self._faces[whole.name].six_numbers(pose)
        rates = self._rates.add(time_s, pose, six, refined.covariance)
        stage_ms["rates"] = 1e3 * (time.perf_counter() - begin)
        return ReflectorObservation(
            Status.OK, time_s=time_s, pose=pose, covariance=refined.covariance, six=six,
            rates=rates, spots=spots, reflectors=names, group=whole.name,
            roll_ambiguous=ambiguous, tracked=tracked, stage_ms=stage_ms,
        )  # fmt: skip
