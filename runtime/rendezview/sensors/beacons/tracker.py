"""The reflector sensor: acquires, tracks and reacquires; one observation a pair of pictures."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.arguments import check_time
from rendezview.sensors.beacons.budget import budget_of, common_of, unknown_of
from rendezview.sensors.beacons.constellation import Face, ReflectorPattern
from rendezview.sensors.beacons.detect.background import Background
from rendezview.sensors.beacons.detect.difference import LitDark, ThresholdOptions
from rendezview.sensors.beacons.detect.spots import MOST_CERTAIN, SpotTable
from rendezview.sensors.beacons.match.acquisition import Acquirer, merged
from rendezview.sensors.beacons.match.acquisition_options import Acquisition, AcquisitionOptions
from rendezview.sensors.beacons.observation import ReflectorObservation, missed, refused, undecided
from rendezview.sensors.beacons.pose.refinement import Refined
from rendezview.sensors.beacons.pose.shares import CAUSES
from rendezview.sensors.beacons.rates import RateEstimator
from rendezview.sensors.beacons.tolerance import NEARER, DotSizes, fit_dots
from rendezview.sensors.beacons.track import (
    Branch,
    Doubt,
    Lights,
    Track,
    TrackingOptions,
    checked_acceleration,
)
from rendezview.sensors.beacons.window_fit import WindowFit
from rendezview.sensors.beacons.windows import VISIBLE
from rendezview.sensors.observation import Status


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
        self.threshold = threshold or ThresholdOptions()
        self.tracking = tracking or TrackingOptions()
        self._given = patterns, acquisition or AcquisitionOptions()
        self._background = Background()
        self._expect(*self._given)
        self._faces = {pattern.name: Face.of(pattern) for pattern in patterns}
        self._rates = RateEstimator()
        self._track: Track | None = None
        self._unconfirmed: tuple[float, Pose, Array] | None = None
        self._lights = Lights(self.tracking.doubt)
        self._note: str | None = None  # of the acquisition
        self._noted_m = np.inf  # range of that
        self._last_s = -np.inf
        self._lock = threading.Lock()
        placed = all(pattern.sigmas_known for pattern in patterns)
        # Of errors of which the files say nothing
        self._unknown = unknown_of(camera=camera.covariance is not None, places=placed)
        self._group_of = [pattern.name for pattern in patterns for _ in pattern.names]
        self._centre = self.constellation.centre_m

    @property
    def is_tracking(self) -> bool:
        """Whether the next reading looks into windows only."""
        return self._track is not None and self._track.misses <= self.tracking.coast

    def start(self, time_s: float, pose: Pose, *, roll_known: bool = True) -> None:
        """Begin to track from a pose of another camera or sensor."""
        with self._lock:
            self._track = Track.begun(time_s, pose, len(self._group_of), roll_known=roll_known)
            self._rates.clear()

    def forget(self) -> None:
        """Begin anew: the next reading knows nothing of those before."""
        with self._lock:
            self._track, self._unconfirmed, self._note, self._last_s = None, None, None, -np.inf
            self._lights = Lights(self.tracking.doubt)
            self._rates = RateEstimator()
            self._dots.clear()
            if self.patterns is not self._given[0]:
                self._expect(*self._given)

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
            check_time(time_s, self._last_s)
            self._last_s = time_s
            self._lights.since += 1
            if self.is_tracking:
                return self._follow(time_s, frames, push)
            return self._acquire(time_s, frames)

    def _acquire(self, time_s: float, frames: LitDark) -> ReflectorObservation:
        prior = None
        if self._track is not None:
            if self._track.misses <= self.tracking.memory:
                prior = self._track.pose
            else:
                self._track = None
        begin = time.perf_counter()
        spots = self._background.spots(time_s, frames, self.threshold)
        middle = time.perf_counter()
        found = self.acquirer.acquire(spots, prior)
        if prior is not None and not self._continues(time_s, found, spots):
            # The last pose is too old to choose by its range.
            found, prior = self.acquirer.acquire(spots), None
            if found.refined is not None:
                light = self._fit.light_of(found, spots, self._track)
                found = found.strange() if light.sum() > self.tracking.jump_limit else found
        if found.refined is None and frames.dark is not None and len(spots) <= MOST_CERTAIN:
            # Discs as faint as the threshold fall to pieces.
            faint = self._background.spots(time_s, frames, self.threshold, faint=True)
            again = self.acquirer.acquire(faint, prior)
            if again.refined is not None:
                spots, found = faint, again
        mirrored = self.acquirer.mirrored(spots, found) if prior is None else None
        if mirrored is None and found.status is Status.NOT_FOUND and self._track is None:
            found = self._with_other_dots(spots) or found
        found = mirrored or found
        self._lights.take(found, spots)
        end = time.perf_counter()
        stage_ms = {"spots": 1e3 * (middle - begin), "triplets": 1e3 * (end - middle)}
        if found.refined is None:
            if self._track is not None:
                self._track.misses += 1
                self._track.aged += 1
            self._unconfirmed = None
            if found.left_out:  # the last pose was that of another group
                self._track = None
            return refused(found, time_s, spots, stage_ms)
        pose = found.refined.camera_from_target
        self._note, self._noted_m = found.note, self.constellation.range_m(pose)
        names = found.names(self.constellation, len(spots))
        if self.tracking.confirm and prior is None and not self._agrees(found, spots):
            self._unconfirmed = (time_s, pose, found.table(spots, len(self.constellation)))
            return ReflectorObservation(
                Status.UNCONFIRMED, "found for the first time: the next reading must agree",
                time_s=time_s, spots=spots, reflectors=names, group=found.group,
                stage_ms=stage_ms,
            )  # fmt: skip
        ambiguous = found.roll_ambiguous
        if prior is not None and self._track is not None:  # it stays as well known as it was
            ambiguous = self._track.roll_ambiguous and not self._resolves(found.reflectors)
        return self._adopt(time_s, found, spots, ambiguous, stage_ms)

    def _with_other_dots(self, spots: SpotTable) -> Acquisition | None:
        """What is found with dots of another diameter or blur, which are then taken for right."""
        fitted = fit_dots(self.camera, self._given[0], self._given[1], spots)
        if fitted is None:
            return None
        self._expect(fitted.patterns, fitted.options)
        self._dots.fitted_note = fitted.note
        return fitted.found

    def _expect(self, patterns: list[ReflectorPattern], options: AcquisitionOptions) -> None:
        self.patterns, self.constellation = patterns, merged(patterns)
        self.acquirer = Acquirer(self.camera, patterns, options)
        self._dots = DotSizes(self.camera, self.constellation, options)
        self._fit = WindowFit(
            self.camera, self.constellation, options, self.tracking, self._background
        )

    def _adopt(
        self, time_s: float, found: Acquisition, spots: SpotTable, ambiguous: bool,
        stage_ms: dict[str, float],
    ) -> ReflectorObservation:  # fmt: skip
        """Track what was found from here on."""
        assert found.refined is not None
        table, refined = found.table(spots, len(self.constellation)), found.refined
        if self._unconfirmed is not None:
            first_s, _, before = self._unconfirmed
            refined = self._fit.at_one_time(refined, table, before, time_s - first_s) or refined
        self._remember(time_s, table, refined, 2.0, ambiguous, Branch.SURE)
        if self._unconfirmed is not None and self._track is not None:
            self._track.before_s, _, first = self._unconfirmed
            self._track.before = first[:, :2].copy()
        self._unconfirmed = None
        names = found.names(self.constellation, len(spots))
        return self._reading(
            time_s, refined, spots, names, found.group, stage_ms, ambiguous, tracked=False
        )

    def _agrees(self, found: Acquisition, spots: SpotTable) -> bool:
        """Whether a second find is near the first, and no light has vanished."""
        first = self._unconfirmed
        near = first is not None and found.is_near(first[1], self._centre)
        return near and not self._lights.vanished(found, spots)

    def _follow(self, time_s: float, frames: LitDark, push: Array | None) -> ReflectorObservation:
        track = self._track
        assert track is not None
        begin = time.perf_counter()
        seen = self._fit.table[self._fit.outcome == VISIBLE]
        used = self._background.followed(frames, seen, time_s)
        noise = self._fit.look(time_s, track, push, used, self.threshold)
        middle, fit, outcome = time.perf_counter(), self._fit, self._fit.outcome
        table = fit.table
        seen = np.flatnonzero(outcome == VISIBLE)
        refined = fit.solve(track.pose, table, seen) if len(seen) >= 3 else None
        count = len(seen)
        if refined is not None and count > 3:
            refined, seen = fit.without_strangers(track.pose, refined, table, seen)
        branch = Branch.SURE if refined is None else fit.branch(track, refined, table, seen)
        ended = time.perf_counter()
        stage_ms = {"windows": 1e3 * (middle - begin), "pose": 1e3 * (ended - middle)}
        outcome[:] = 0
        outcome[seen] = VISIBLE
        if refined is None and not np.isfinite(track.before).any():
            # The motion is not known: windows are of little use.
            return self._acquire(time_s, frames)
        doubt = track.doubts(table, seen, self.tracking)
        if refined is not None:
            jumps, light = self._rates.jumps, fit.light[seen]
            # Another light in a window may be as likely.
            if jumps(time_s, refined, light, track, self.tracking, doubt) or any(
                not jumps(time_s, other, shine, track, self.tracking, max(doubt, Doubt.SOME))
                for other, shine in fit.with_rivals(track, seen)
            ):
                refined, seen, branch = None, seen[:0], Branch.SURE
        contradiction = self._contradiction(time_s, frames, track, refined, seen, stage_ms, doubt)
        if contradiction is not None:
            return contradiction
        names = tuple(self.constellation.names[k] for k in seen)
        spots = SpotTable(table[seen])
        if refined is None:
            track.misses += 1
            if len(seen) and track.misses <= self.tracking.coast:
                track.follow(time_s, seen, table)
            return missed(
                time_s, spots, names, fit.missing(names), stage_ms, search=not self.is_tracking,
                strange=count > len(seen),
            )  # fmt: skip
        table = table.copy()
        table[outcome != VISIBLE] = np.nan
        ambiguous = track.roll_ambiguous and not self._resolves(seen)
        self._remember(time_s, table, refined, noise, ambiguous, branch, fit.light)
        if branch is Branch.OPEN:
            self._rates.clear()
            return undecided(
                f"two poses show the same {len(seen)} spots, and the motion does not tell them "
                "apart: uncover more reflectors", time_s, spots, names, stage_ms, tracked=True,
            )  # fmt: skip
        return self._reading(
            time_s, refined, spots, names, None, stage_ms, ambiguous, tracked=True, doubt=doubt
        )

    def _contradiction(
        self, time_s: float, frames: LitDark, track: Track, refined: Refined | None,
        seen: npt.NDArray[np.int64], stage_ms: dict[str, float], doubt: Doubt,
    ) -> ReflectorObservation | None:  # fmt: skip
        """The reading, where a search of the whole picture finds a pose that explains more spots.

        It is searched while a reflector that should be visible is not, or while the roll is open
        and another group could tell it. A second reading that agrees takes the track over. A group
        that is left out and fits as well is compared again as the target comes nearer.
        Where the windows show no pose, one near the last is taken at once: the camera jerked.
        """
        several = track.roll_ambiguous and len(self.patterns) > 1
        range_m = math.inf if self._note is None else self.constellation.range_m(track.pose)
        doubted = range_m < NEARER * self._noted_m
        if not (several or doubted or refined is None or self._fit.misses(seen)):
            self._unconfirmed = None
            return None
        begin = time.perf_counter()
        spots = self._background.spots(time_s, frames, self.threshold)
        more = doubted or len(spots) > max(len(seen), 2)
        found = self.acquirer.acquire(spots) if more else None
        jerked = self.acquirer.acquire(spots, track.pose) if found and refined is None else None
        self._lights.take(found, spots)
        stage_ms["search"] = 1e3 * (time.perf_counter() - begin)
        near = jerked is not None and jerked.is_near(track.pose, self._centre)
        if jerked and near and self._continues(time_s, jerked, spots, doubt):
            ambiguous = track.roll_ambiguous and not self._resolves(jerked.reflectors)
            return self._adopt(time_s, jerked, spots, ambiguous, stage_ms)
        if found is not None and found.left_out:
            self._track = None
            return refused(found, time_s, spots, stage_ms)
        if found is None or found.refined is None or found.reflectors is None:
            return None
        if doubted:
            self._note, self._noted_m = found.note, range_m
        pose, confirms = found.refined.camera_from_target, False
        if refined is not None:
            alike = self.acquirer.alike(found, refined.camera_from_target)
            confirms = alike and several and self._resolves(found.reflectors)
            if len(found.reflectors) <= len(seen) or (alike and not confirms):
                return None
        if refined is None and not self._continues(time_s, found, spots):
            return None
        if self._agrees(found, spots):
            self._track = None
            return self._adopt(time_s, found, spots, found.roll_ambiguous, stage_ms)
        self._unconfirmed = (time_s, pose, found.table(spots, len(self.constellation)))
        if refined is None or confirms:
            return None
        return undecided(
            f"another pose explains {len(found.reflectors)} spots and the one that was followed "
            f"{len(seen)}: the next reading decides",
            time_s, spots, found.names(self.constellation, len(spots)), stage_ms, tracked=False,
        )  # fmt: skip

    def _continues(
        self, time_s: float, found: Acquisition, spots: SpotTable, doubt: Doubt = Doubt.NONE
    ) -> bool:
        """Whether there is a pose that does not break with the readings before."""
        if found.refined is None:
            return False
        light = self._fit.light_of(found, spots, self._track)
        jumps = self._rates.jumps
        return not jumps(time_s, found.refined, light, self._track, self.tracking, doubt)

    def _resolves(self, seen: npt.NDArray[np.int64] | None) -> bool:
        """Whether reflectors of two groups are visible: their offset fixes the roll."""
        if seen is None or len(self.patterns) == 1:
            return False
        return len({self._group_of[k] for k in seen}) > 1

    def _remember(
        self, time_s: float, table: Array, refined: Refined, noise: float, ambiguous: bool,
        branch: Branch, light: Array | None = None,
    ) -> None:  # fmt: skip
        last = self._track
        if last is None or last.misses > self.tracking.coast:
            self._rates.clear()
        self._track = Track.after(
            last, time_s, table, refined, noise, ambiguous, branch, self.tracking.coast, light
        )

    def _reading(
        self, time_s: float, refined: Refined, spots: SpotTable, names: tuple[str | None, ...],
        group: str | None, stage_ms: dict[str, float], ambiguous: bool, tracked: bool,
        doubt: Doubt = Doubt.NONE,
    ) -> ReflectorObservation:  # fmt: skip
        begin = time.perf_counter()
        pose = refined.camera_from_target
        whole = next(
            (p for p in self.patterns if all(name in names for name in p.names)),
            next((p for p in self.patterns if p.name == group), self.patterns[0]),
        )
        face = self._faces[whole.name]
        six = face.six_numbers(pose)
        rates = self._rates.last
        if doubt is not Doubt.OTHER:  # another spot tells nothing of the motion
            rates = self._rates.add(time_s, pose, refined.scatter, face, refined.slow)
        self._dots.take(pose, spots, names)
        shares = dict(zip(CAUSES, refined.shares, strict=True)) | self._unknown
        stage_ms["rates"] = 1e3 * (time.perf_counter() - begin)
        return ReflectorObservation(
            Status.OK, time_s=time_s, pose=pose, covariance=refined.covariance, six=six,
            rates=rates, spots=spots, reflectors=names, group=whole.name,
            roll_ambiguous=ambiguous, tracked=tracked, stage_ms=stage_ms,
            note="; ".join(filter(None, (self._dots.note, self._note))) or None,
            common=common_of(shares), budget=budget_of(shares),
        )  # fmt: skip
