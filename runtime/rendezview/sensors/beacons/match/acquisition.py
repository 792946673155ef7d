"""Acquisition: finds the target among the spots of one picture, without a prior."""

from __future__ import annotations

import contextlib
import math
import threading
from dataclasses import astuple, dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.estimation.p3p import MAX_ROOTS
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.cover import uncovered_sizes
from rendezview.sensors.beacons.detect.lens_scale import LensScale
from rendezview.sensors.beacons.detect.spot_columns import (
    AMPLITUDE,
    BOTTOM,
    LEFT,
    RIGHT,
    SHAPE,
    SIZE,
    TOP,
)
from rendezview.sensors.beacons.detect.spots import SpotTable
from rendezview.sensors.beacons.match.acquisition_options import (
    MIRRORED,
    Acquisition,
    AcquisitionOptions,
)
from rendezview.sensors.beacons.match.choice import Candidates, Chooser
from rendezview.sensors.beacons.match.judgement import judge
from rendezview.sensors.beacons.match.triplets import (
    PAPER_HOURGLASS,
    Hourglass,
    hourglass_of,
    search,
)
from rendezview.sensors.observation import Status

# ×; a group that is left out is looked for so much farther away and nearer. Source: by
# construction, above the ratio of two groups for one approach
_ANYWHERE = 10.0
_MOST_TRIPLETS = 20_000  # Source: by construction, a bound of memory
_MIDWAY = 1e-3  # base lengths off the base's middle, head-on. Source: by construction
_NO_RANGE = np.array([0.0, np.inf])  # m. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class _Triangle:
    """A triangle of one group, ready for the search."""

    group: int
    members: npt.NDArray[np.int64]  # (3,) left, centre, right, of the whole constellation
    glass: Array  # (5,) hourglass
    longest_side: float
    base_m: float
    diameters_m: Array  # (3,)
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
        self._lens_scale = LensScale(camera, self.options.blur_px)
        self._triangles = self._ready()
        self._chooser = Chooser(camera, patterns, self.constellation, self.options)
        without = replace(
            self.options,
            left_out=(),
            nearest_m=self.options.nearest_m / _ANYWHERE,
            farthest_m=self.options.farthest_m * _ANYWHERE,
        )
        self._left_out = []
        for pattern in self.options.left_out:
            with contextlib.suppress(RendezviewError):  # no pose by the printed hourglass
                self._left_out.append(Acquirer(camera, [pattern], without))
        self._mirrored: Acquirer | None = None
        self._triplets = np.empty((_MOST_TRIPLETS, 3), np.int64)  # scratch
        self._lock = threading.Lock()  # of the scratch

    def acquire(self, spots: SpotTable, prior: Pose | None = None) -> Acquisition:
        """Find the target.

        Args:
            spots: of the picture.
            prior: the last pose: the range must agree with it (re-acquisition), and of several
                poses that look the same the one with its roll is taken.
        """
        found = self._acquire(self._lens_scale.straightened(spots), prior)
        if found.status not in (Status.OK, Status.NOT_FOUND):
            return found
        return self._against_left_out(found, spots)

    def _against_left_out(self, found: Acquisition, spots: SpotTable) -> Acquisition:
        """What was found, unless the spots are those of a group that is said not to be there.

        The last pose is no evidence: it is as wrong as the group is. So these groups are looked for
        at any range. They count even where several of their poses show the spots.
        """
        notes, margin = [], self.options.rival_margin
        for other in self._left_out:
            theirs = other.acquire(spots)
            if not (theirs.explains_more(found) or theirs.shares(found)):
                continue
            name = f"the group {theirs.group!r}, which is left out"
            if theirs.explains_more(found) or found.score > theirs.score + margin:
                return Acquisition(
                    Status.AMBIGUOUS,
                    f"the spots are those of {name}: name it with --group, or leave --group out",
                    left_out=True,
                )
            if found.score + margin > theirs.score:
                where = "in several poses"
                if theirs.refined is not None:
                    away_m = np.linalg.norm(theirs.refined.camera_from_target.translation_m)
                    where = f"{away_m:.3g} m away"
                notes.append(f"{name}, fits these spots as well, {where}")
        return replace(found, note="; ".join(notes)) if notes else found

    def _acquire(self, spots: SpotTable, prior: Pose | None) -> Acquisition:
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
        sizes = spots.table[usable, SIZE]
        with self._lock:
            candidates, crowded = self._candidates(spots, usable, sizes, prior)
            if not (crowded or len(candidates.rows)):
                # One may be partly hidden, and smaller for that.
                whole = uncovered_sizes(spots.table[usable], self.options.blur_px)
                if (whole > sizes).any():
                    candidates, crowded = self._candidates(spots, usable, whole, prior)
        if crowded:
            return Acquisition(
                Status.CROWDED,
                f"more than {_MOST_TRIPLETS} of the triplets of {len(usable)} spots pass the "
                "tests: raise the threshold, or shield the camera",
            )
        if not len(candidates.rows):
            return Acquisition(
                Status.NOT_FOUND,
                f"{len(usable)} spots, but no three match the target in place, brightness and size",
            )
        return self._chooser.choose(spots, usable, candidates, prior)

    def alike(self, found: Acquisition, pose: Pose) -> bool:
        """Whether what was found is a pose, or one that looks the same, to 0.1 rad and 4 σ."""
        assert found.refined is not None
        assert found.reflectors is not None
        return self._chooser.looks_like(found.refined, found.reflectors, pose)

    def mirrored(self, spots: SpotTable, found: Acquisition) -> Acquisition | None:
        """What is found in place of a pose, where spots show the target's mirror image; or None.

        Three reflectors and their normals in one plane are their own mirror image: these cannot
        tell.
        """
        if found.status in (Status.NO_SPOTS, Status.CROWDED) or found.left_out:
            return None
        if found.reflectors is not None and len(found.reflectors) == len(self.constellation):
            return None
        if self._mirrored is None:
            images = [pattern.mirrored() for pattern in self.patterns]
            self._mirrored = Acquirer(self.camera, images, replace(self.options, left_out=()))
        theirs = self._mirrored.acquire(spots)
        # A flat pattern may have several poses; facing away, the spots have none.
        unlike = found.status is Status.NOT_FOUND and theirs.status is Status.AMBIGUOUS
        if not (unlike or theirs.explains_more(found)):
            return None
        return Acquisition(Status.NOT_FOUND, MIRRORED)

    def _ready(self) -> list[_Triangle]:
        ready, first = [], 0
        for group, pattern in enumerate(self.patterns):
            # Three visible reflectors of a redundant target may be any of its triangles.
            for triangle in pattern.triangles():
                glass, own = self._hourglass(pattern, triangle), list(triangle)
                if glass is None:
                    continue
                places, diameters_m = pattern.positions_m[own], pattern.diameters_m[own]
                names = tuple(pattern.names[k] for k in own)
                only = ReflectorPattern(
                    pattern.name, names, places, pattern.normals[own], diameters_m
                )
                ready.append(
                    _Triangle(
                        group, np.array(own, dtype=np.int64) + first, np.array(astuple(glass)),
                        glass.longest_side, float(np.linalg.norm(places[2] - places[0])),
                        diameters_m, (2, 1, 0) not in only.symmetries(),
                    )
                )  # fmt: skip
            first += len(pattern)
        if not ready:
            raise RendezviewError(
                "the printed hourglass is that of a centre reflector on a post midway over the "
                "base, and this target has none: leave --hourglass out"
            )
        return ready

    def _hourglass(
        self, pattern: ReflectorPattern, triangle: tuple[int, int, int]
    ) -> Hourglass | None:
        """Of a triangle (left, centre, right); None: the printed one does not hold for it."""
        glass = hourglass_of(pattern, triangle, self.options.tilt_rad)
        if not self.options.paper_hourglass:
            return glass
        return PAPER_HOURGLASS if abs(glass.x0) + abs(glass.y0) < _MIDWAY else None

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
        self, spots: SpotTable, usable: npt.NDArray[np.int64], sizes: Array, prior: Pose | None
    ) -> tuple[Candidates, bool]:
        """Candidates of spots of some sizes (K,), and whether there are too many of them."""
        options, camera = self.options, self.camera
        rays = camera.rays(spots.centroids_px[usable])
        seen = np.isfinite(rays).all(axis=1)
        usable, sizes, rays = usable[seen], sizes[seen], rays[seen]
        directions = rays / np.sqrt((rays * rays).sum(axis=1))[:, None]
        flat = np.ascontiguousarray(rays[:, :2] * camera.fx)
        peaks = spots.table[usable, AMPLITUDE]
        order = np.argsort(flat[:, 0], kind="stable")
        window = _NO_RANGE
        if prior is not None:
            expected = prior.apply(self.constellation.centre_m)
            last = float(np.linalg.norm(expected))
            window = last * np.array([1 - options.reacquisition, 1 + options.reacquisition])
        window = np.array([max(window[0], options.nearest_m), min(window[1], options.farthest_m)])
        triplets = self._triplets
        found: list[tuple[npt.NDArray[np.int64], Array, Array]] = []
        nothing = Candidates(np.empty((0, 5), np.int64), np.empty(0), np.empty((0, 12)))
        for number, triangle in enumerate(self._triangles):
            foreshortened = math.cos(options.tilt_rad)
            limits = (
                triangle.base_m * camera.fx * foreshortened / window[1],
                1.05 * triangle.base_m * camera.fx / window[0],
                options.size_limit, options.peak_limit, options.blur_sigma, foreshortened,
                triangle.longest_side,
            )  # fmt: skip
            count = search(
                directions, flat, sizes, peaks, order, triangle.glass, triangle.base_m,
                triangle.diameters_m, camera.fx, options.blur_px, limits, triangle.both_ways,
                triplets,
            )  # fmt: skip
            if count < 0:
                return nothing, True
            if count == 0:
                continue
            scores, poses = np.empty((count, MAX_ROOTS)), np.empty((count, MAX_ROOTS, 12))
            members = triangle.members
            judge(
                triplets[:count], directions, sizes, peaks, self.constellation.positions_m[members],
                self.constellation.normals[members], self.constellation.diameters_m[members],
                camera.fx, options.blur_px,
                (options.size_sigma, options.diameter_sigma, options.blur_sigma,
                 options.peak_sigma, options.beam_sigma, options.least_cosine,
                 options.beam_curve),
                window, options.score_limit, scores, poses,
            )  # fmt: skip
            good, root = np.nonzero(scores <= options.score_limit)
            if good.size:
                first = np.tile((number, triangle.group), (good.size, 1))
                rows = np.column_stack([first, usable[triplets[good]]])
                found.append((rows, scores[good, root], poses[good, root]))
        if not found:
            return nothing, False
        rows, scores, poses = (np.concatenate(parts) for parts in zip(*found, strict=True))
        best = np.argsort(scores, kind="stable")
        return Candidates(rows[best], scores[best], poses[best]), False


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
        sigmas_m=np.concatenate([pattern.sigmas_m for pattern in patterns]),
    )
