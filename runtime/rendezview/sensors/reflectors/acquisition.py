"""Acquisition: finds the target among the spots of one picture, without a prior."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.observation import Status
from rendezview.sensors.reflectors.discs import camera_numbers
from rendezview.sensors.reflectors.judgement import judge
from rendezview.sensors.reflectors.matching import match_spots
from rendezview.sensors.reflectors.pattern import ReflectorPattern
from rendezview.sensors.reflectors.refinement import Refined, refine
from rendezview.sensors.reflectors.spots import (
    AMPLITUDE,
    BOTTOM,
    LEFT,
    RIGHT,
    SHAPE,
    SIZE,
    TOP,
    SpotTable,
)
from rendezview.sensors.reflectors.triplets import hourglass_of, search

_MOST_TRIPLETS = 20_000  # Source: by construction, a bound of memory
_MOST_CANDIDATES = 12  # are looked at one by one, the best first
_NO_RANGE = np.array([0.0, np.inf])  # m. Source: by construction


@dataclass(frozen=True, slots=True, kw_only=True)
class AcquisitionOptions:
    """Which triplets pass for the target. Tolerances are those of one spot, one σ."""

    # Yaw and pitch against the line of sight. Source: Book et al. 1992, fig. 2, has ±40° on the
    # boresight.
    tilt_rad: float = math.radians(45.0)
    nearest_m: float = 0.3
    farthest_m: float = 150.0
    blur_px: float = 0.75  # σ of the optics and of a pixel's width together
    size_sigma: float = 0.035  # of ln(size): noise, focus, the disc's own tilt
    peak_sigma: float = 0.08  # of ln(brightness) of the centre spot against the outer two
    beam_sigma: float = 0.5  # of ln(brightness) between the outer two: the beam has a middle
    size_limit: float = 0.14  # ln, of one spot before anything else is tried
    peak_limit: float = 1.6  # ln, between two spots
    least_shape: float = 0.55  # small over large axis: a disc at 40° has 0.77, an edge far less
    score_limit: float = 18.0  # χ² of three sizes and brightnesses
    rival_margin: float = 2.5  # χ² by which the best must win over other spots
    # Triplets as good as the best that chance may bring. Those of chance with five terms of
    # χ² below s grow as s^5/2, and all that pass but the best give their number.
    chance: float = 0.25
    match_px: float = 1.5  # a further reflector is its spot when this near
    reacquisition: float = 0.25  # of the last range: how far the new one may be

    def __post_init__(self) -> None:
        if not 0.0 < self.tilt_rad < math.pi / 2:
            raise RendezviewError(f"tilt_rad must be between 0 and π/2, not {self.tilt_rad}")
        if not 0.0 < self.nearest_m < self.farthest_m:
            raise RendezviewError(
                f"nearest_m and farthest_m must rise from above 0: {self.nearest_m}, "
                f"{self.farthest_m}"
            )
        if not self.blur_px > 0.0:
            raise RendezviewError(f"blur_px must be positive, not {self.blur_px}")


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """The result of one picture; no pose without ``Status.OK``."""

    status: Status
    reason: str | None
    refined: Refined | None = None
    group: str | None = None
    reflectors: npt.NDArray[np.int64] | None = None  # (K,) of the whole constellation
    spot_indices: npt.NDArray[np.int64] | None = None  # (K,) the spot of each
    score: float = math.inf
    roll_ambiguous: bool = (
        False  # a symmetry of the visible reflectors leaves the picture unchanged
    )
    rival_score: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class _Triangle:
    """A triangle of one group, ready for the search."""

    group: str
    members: npt.NDArray[np.int64]  # (3,) left, centre, right, of the whole constellation
    glass: Array  # (5,) hourglass
    longest_side: float
    base_m: float
    diameter_m: float
    both_ways: bool


class Acquirer:
    """Looks for the groups of a target in the spots of one camera.

    ``constellation`` holds the reflectors of all groups; numbers of reflectors are its own.
    Threads may share an instance: their searches run one after the other.
    """

    def __init__(
        self,
        camera: Camera,
        patterns: list[ReflectorPattern],
        options: AcquisitionOptions | None = None,
    ) -> None:
        self.camera = camera
        self.patterns = patterns
        self.options = options or AcquisitionOptions()
        self.constellation = merged(patterns)
        self._triangles = self._ready()
        # Turned by one of these a group looks the same.
        self._turns = {p.name: [Pose.identity(), *_turns(p)] for p in patterns}
        self._bases = {
            p.name: p.positions_m[p.base[1]] - p.positions_m[p.base[0]] for p in patterns
        }
        self._groups = [p.name for p in patterns for _ in p.names]
        # A triangle's own group first: of two reflectors in one place it has the better claim.
        self._orders = {
            p.name: np.argsort([g != p.name for g in self._groups], kind="stable") for p in patterns
        }
        self._lens = camera_numbers(camera, self.options.blur_px)
        self._triplets = np.empty((_MOST_TRIPLETS, 3), np.int64)  # scratch
        self._lock = threading.Lock()  # of the scratch

    def acquire(self, spots: SpotTable, prior: Pose | None = None) -> Acquisition:
        """Find the target.

        Args:
            spots: of the picture.
            prior: the last pose: the range must agree with it (re-acquisition), and of several
                poses that look the same the one with its roll is taken.
        """
        if spots.overfull:
            return Acquisition(
                Status.CROWDED,
                f"more than {len(spots)} spots: raise the threshold, or shield the camera",
            )
        usable = self._usable(spots)
        if len(usable) < 3:
            return Acquisition(
                Status.NO_SPOTS,
                f"{len(spots)} spots, {len(usable)} of them round and whole; three are needed",
            )
        with self._lock:
            rows, scores, poses, crowded = self._candidates(spots, usable, prior)
        if crowded:
            return Acquisition(
                Status.CROWDED,
                f"more than {_MOST_TRIPLETS} of the triplets of {len(usable)} spots pass the "
                "tests: raise the threshold, or shield the camera",
            )
        if not len(rows):
            return Acquisition(
                Status.NOT_FOUND,
                f"{len(usable)} spots, but no three match the target in place, brightness and size",
            )
        return self._choose(spots, usable, rows, scores, poses, prior)

    def _ready(self) -> list[_Triangle]:
        ready = []
        first = 0
        for pattern in self.patterns:
            triangles = pattern.triangles()
            # Three visible reflectors of a redundant target may be any of its triangles.
            for triangle in triangles:
                left, _, right = triangle
                positions = pattern.positions_m
                glass = hourglass_of(pattern, triangle, self.options.tilt_rad)
                only = ReflectorPattern(
                    pattern.name,
                    tuple(pattern.names[k] for k in triangle),
                    positions[list(triangle)],
                    pattern.normals[list(triangle)],
                    pattern.diameters_m[list(triangle)],
                )
                ready.append(
                    _Triangle(
                        pattern.name,
                        np.array(triangle, dtype=np.int64) + first,
                        glass.as_array(),
                        glass.longest_side,
                        float(np.linalg.norm(positions[right] - positions[left])),
                        float(pattern.diameters_m[list(triangle)].mean()),
                        not any(order == (2, 1, 0) for order in only.symmetries()),
                    )
                )
            first += len(pattern)
        return ready

    def _usable(self, spots: SpotTable) -> npt.NDArray[np.int64]:
        """Spots that are round and do not touch the border."""
        table = spots.table
        whole = (
            (table[:, LEFT] > 0)
            & (table[:, TOP] > 0)
            & (table[:, RIGHT] < self.camera.width - 1)
            & (table[:, BOTTOM] < self.camera.height - 1)
        )
        round_ = table[:, SHAPE] >= self.options.least_shape
        return np.flatnonzero(whole & round_ & (table[:, AMPLITUDE] > 0.0))

    def _candidates(
        self, spots: SpotTable, usable: npt.NDArray[np.int64], prior: Pose | None
    ) -> tuple[npt.NDArray[np.int64], Array, Array, bool]:
        """(K, 4) triangle, left, centre, right; (K,) χ²; (K, 12) poses; whether there are too many.

        Best first.
        """
        options, camera = self.options, self.camera
        rays = camera.rays(spots.centroids_px[usable])
        seen = np.isfinite(rays).all(axis=1)
        usable, rays = usable[seen], rays[seen]
        directions = rays / np.sqrt((rays * rays).sum(axis=1))[:, None]
        flat = np.ascontiguousarray(rays[:, :2] * camera.fx)
        sizes, peaks = spots.table[usable, SIZE], spots.table[usable, AMPLITUDE]
        order = np.argsort(flat[:, 0], kind="stable")
        window = _NO_RANGE
        if prior is not None:
            expected = prior.apply(self.constellation.centre_m)
            last = float(np.linalg.norm(expected))
            window = last * np.array([1 - options.reacquisition, 1 + options.reacquisition])
        window = np.array([max(window[0], options.nearest_m), min(window[1], options.farthest_m)])
        triplets = self._triplets
        found: list[tuple[npt.NDArray[np.int64], Array, Array]] = []
        for number, triangle in enumerate(self._triangles):
            foreshortened = math.cos(options.tilt_rad)
            limits = (
                triangle.base_m * camera.fx * foreshortened / window[1],
                1.05 * triangle.base_m * camera.fx / window[0],
                options.size_limit, options.peak_limit, foreshortened, triangle.longest_side,
            )  # fmt: skip
            count = search(
                directions, flat, sizes, peaks, order, triangle.glass, triangle.base_m,
                triangle.diameter_m, camera.fx, options.blur_px, limits, triangle.both_ways,
                triplets,
            )  # fmt: skip
            if count < 0:
                return np.empty((0, 4), np.int64), np.empty(0), np.empty((0, 12)), True
            if count == 0:
                continue
            scores, poses = np.empty(count), np.empty((count, 12))
            members = triangle.members
            judge(
                triplets[:count], directions, sizes, peaks, self.constellation.positions_m[members],
                self.constellation.normals[members], self.constellation.diameters_m[members],
                camera.fx, options.blur_px,
                (options.size_sigma, options.peak_sigma, options.beam_sigma,
                 math.cos(1.2 * options.tilt_rad)),
                window, options.score_limit, True, scores, poses,
            )  # fmt: skip
            good = np.flatnonzero(scores <= options.score_limit)
            if good.size:
                rows = np.column_stack([np.full(good.size, number), usable[triplets[good]]])
                found.append((rows, scores[good], poses[good]))
        if not found:
            return np.empty((0, 4), np.int64), np.empty(0), np.empty((0, 12)), False
        rows, scores, poses = (np.concatenate(parts) for parts in zip(*found, strict=True))
        best = np.argsort(scores, kind="stable")
        return rows[best], scores[best], poses[best], False

    def _choose(
        self,
        spots: SpotTable,
        usable: npt.NDArray[np.int64],
        rows: npt.NDArray[np.int64],
        scores: Array,
        poses: Array,
        prior: Pose | None,
    ) -> Acquisition:
        """Of the candidates the one that explains most spots best, unless another comes close."""
        judged = []
        # Where there are no more than three reflectors no candidate can explain more spots.
        without_rivals = len(self.constellation) == 3
        few = slice(0, 1 if without_rivals else _MOST_CANDIDATES)
        for row, score, numbers in zip(rows[few], scores[few], poses[few], strict=True):
            triangle = self._triangles[row[0]]
            for pose in self._turned(triangle, numbers, prior):
                which, where = self._matches(spots, usable, triangle, row[1:], pose)
                judged.append((len(which), -float(score), triangle, which, where, pose))
        judged.sort(key=lambda item: item[:2], reverse=True)
        most, score, triangle, which, where, pose = judged[0]
        # The same spots under another numbering are no rivals: the target looks alike that way.
        mine = set(where.tolist())
        rivals = [item for item in judged[1:] if item[0] == most and set(item[4].tolist()) != mine]
        rival = -max((item[1] for item in rivals), default=-math.inf)
        others = ~(rows[:, 1:, None] == where).any(axis=2).all(axis=1)
        if without_rivals and others.any():
            rival = float(scores[others].min())
        if rival + score < self.options.rival_margin:
            return Acquisition(
                Status.AMBIGUOUS,
                f"two sets of spots pass for the target (χ² {-score:.1f} and {rival:.1f}): "
                "give a prior, or look again",
            )
        by_chance = float(others.sum()) * (-score / self.options.score_limit) ** 2.5
        if by_chance > self.options.chance:
            return Acquisition(
                Status.AMBIGUOUS,
                f"{int(others.sum())} other sets of spots pass for the target too, so that the "
                f"best (χ² {-score:.1f}) may be chance: give a prior, or look again",
            )
        refined = refine(
            self.camera, self.constellation, spots.table[where, :2], which, pose,
            np.maximum(spots.sigma_px[where], 1e-3), self.options.blur_px,
        )  # fmt: skip
        if refined is None or not refined.converged:
            return Acquisition(
                Status.NOT_FOUND, "three spots pass for the target, but no pose fits them"
            )
        groups = {self._groups[int(k)] for k in which}
        alike = [
            item
            for item in judged[1:]
            if item[0] == most
            and set(item[4].tolist()) == mine
            and np.trace(item[5].rotation @ pose.rotation.T) < 2.96  # 0.2 rad apart
        ]
        ambiguous = prior is None and (
            bool(alike) or (len(groups) == 1 and len(self._turns[triangle.group]) > 1)
        )
        return Acquisition(
            Status.OK, None, refined, triangle.group, which, where, -score, ambiguous, rival
        )

    def _turned(self, triangle: _Triangle, numbers: Array, prior: Pose | None) -> list[Pose]:
        """The pose, and those that show the same spots of its group; that with the prior's roll
        (without one: the least roll) first."""
        pose = Pose(numbers[:9].reshape(3, 3), numbers[9:])
        poses = [pose @ turn for turn in self._turns[triangle.group]]
        if prior is not None:
            last = prior
            return sorted(poses, key=lambda p: p.angle_to(last))
        along = self._bases[triangle.group]
        return sorted(poses, key=lambda p: -float(p.rotation[0] @ along))

    def _matches(
        self,
        spots: SpotTable,
        usable: npt.NDArray[np.int64],
        triangle: _Triangle,
        three: npt.NDArray[np.int64],
        pose: Pose,
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Reflectors (K,) and their spots (K,): the three, as numbered by this pose, and others
        that agree with this pose in place and size."""
        which = np.empty(len(self.constellation), np.int64)
        where = np.empty(len(self.constellation), np.int64)
        count = match_spots(
            self._lens, self.constellation.positions_m, self.constellation.normals,
            self.constellation.diameters_m, np.ascontiguousarray(pose.rotation),
            np.ascontiguousarray(pose.translation_m), self.camera.fx, self.options.blur_px,
            self._orders[triangle.group], spots.table, usable, three,
            (self.options.match_px, 2.0 * self.options.size_limit), which, where,
        )  # fmt: skip
        return which[:count], where[:count]


def _turns(pattern: ReflectorPattern) -> list[Pose]:
    """The turns of the target frame that bring a pattern onto itself."""
    centre = pattern.centre_m
    centred = pattern.positions_m - centre
    turns = []
    for order in pattern.symmetries():
        u, _, vt = np.linalg.svd(centred[list(order)].T @ centred)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turns.append(Pose(turn, centre - turn @ centre))
    return turns


def merged(patterns: list[ReflectorPattern]) -> ReflectorPattern:
    """The reflectors of several groups as one constellation, in the order given."""
    if len(patterns) == 1:
        return patterns[0]
    return replace(
        patterns[0],
        name="+".join(pattern.name for pattern in patterns),
        names=tuple(name for pattern in patterns for name in pattern.names),
        positions_m=np.concatenate([pattern.positions_m for pattern in patterns]),
        normals=np.concatenate([pattern.normals for pattern in patterns]),
        diameters_m=np.concatenate([pattern.diameters_m for pattern in patterns]),
    )
