"""Options and result of the acquisition."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.cover import SIZE_SIGMA
from rendezview.sensors.beacons.detect.discs import BLUR_PX
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS
from rendezview.sensors.beacons.detect.spots import SpotTable
from rendezview.sensors.beacons.pose.refinement import Refined
from rendezview.sensors.observation import Status

# × the tilt: that of a single reflector, which is seen at another angle than the middle. Source: by
# construction, a base as wide as a third of its range
_EACH = 1.2

# Source: by construction, a message
MIRRORED = (
    "the picture looks mirrored: its spots are the target's mirror image; turn the mirroring "
    "(selfie view) of the camera off, or flip the pictures"
)


STRANGE = (
    "the spots where reflectors were expected contradict each other, their light or the motion: "
    "they may be others"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class AcquisitionOptions:
    """Which triplets pass for the target. Tolerances are those of one spot, one σ."""

    # Groups of the target that are said not to be there. Where the spots fit one of them better,
    # there is no pose.
    left_out: tuple[ReflectorPattern, ...] = ()
    # Yaw and pitch against the line of sight: of a steeper target others pass for it. Source: plain
    # simulator, seeds 21 and 22, right to 75°
    tilt_rad: float = math.radians(65.0)
    paper_hourglass: bool = False  # the lines of fig. 2 as printed, in place of the target's own
    nearest_m: float = 0.3  # m. Source: a chosen limit
    farthest_m: float = 150.0  # m. Source: a chosen limit
    blur_px: float = BLUR_PX  # σ of the optics and of a pixel's width together
    size_sigma: float = SIZE_SIGMA
    # Of ln(brightness) of the centre spot against the outer two. Source: by hand; uncritical halved
    # or doubled
    peak_sigma: float = 0.08
    # Of ln(brightness) between the outer two: the beam has a middle. Source: by hand; uncritical
    # halved or doubled
    beam_sigma: float = 0.5
    # … and the centre is brighter than the mean of the outer two: ln(brightness) a rad² of half the
    # base as seen, squared. Source: by construction, ln 2 / (20°)² of a beam of ±20° half power
    beam_curve: float = 5.7
    diameter_sigma: float = 0.03  # of ln(diameter), of all alike. Source: a ruler on 10 mm
    # Of ln(blur), of all alike. Source: experiment reflector-hidden --seed 1, whose blur varies by
    # ±20 %
    blur_sigma: float = 0.12
    # ln, of one spot before anything else is tried. Source: by hand; uncritical halved or doubled
    size_limit: float = 0.14
    # ln, between two spots. Source: by hand; uncritical halved or doubled
    peak_limit: float = 1.6
    # Small over large axis: a disc at tilt_rad has 0.42, an edge far less. Source: by construction,
    # between the two
    least_shape: float = 0.3
    # χ² of three sizes and brightnesses. Source: by hand; uncritical halved or doubled
    score_limit: float = 18.0
    # χ² by which the best must win over other spots. Source: by hand; uncritical halved or doubled
    rival_margin: float = 2.5
    # χ² by which it must win over other poses of the same spots, and over other spots where more
    # reflectors might have confirmed it. Source: 2 ln 1000; reflector-hidden --seed 1 is as good as
    # with 16
    pose_margin: float = 13.8
    # Triplets as good as the best that chance may bring. Those of chance with five terms of
    # χ² below s grow as s^5/2, and all that pass but the best give their number.
    chance: float = 0.25  # Source: by hand; uncritical halved or doubled
    # χ² of three spots of a target with more reflectors. Source: experiment reflector-hidden
    sparse_limit: float = 8.0
    # A further reflector is its spot when this near. Source: by hand; uncritical halved or doubled
    match_px: float = 1.5
    # Of a fit to four or more spots: σ of a place beside the noise, px and share of the spot's
    # size (even light moves it). Beyond gate_sigma is another spot. Source: reflector-hidden
    gate_px: float = 0.015
    # Source: experiment reflector-hidden --seed 1
    gate_size: float = 0.01
    # Source: experiment reflector-hidden --seed 1
    gate_sigma: float = 5.0
    # Of the last range: how far the new one may be. Source: by hand; uncritical halved or doubled
    reacquisition: float = 0.25

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

    @property
    def least_cosine(self) -> float:
        """Least cosine between a reflector's normal and its line of sight."""
        return math.cos(_EACH * self.tilt_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """The result of one picture; no pose without ``Status.OK``.

    An ambiguous one may name the best group and its spots, but no reflectors.
    """

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

    note: str | None = None  # what does not keep it from being a pose
    left_out: bool = False  # the spots are those of a group that is said not to be there

    def strange(self) -> Acquisition:
        """The same without its pose, which contradicts what was known of the reflectors."""
        return replace(self, status=Status.AMBIGUOUS, reason=STRANGE, refined=None)

    def shares(self, other: Acquisition) -> bool:
        """Whether both have the same spots."""
        if self.spot_indices is None or other.spot_indices is None:
            return False
        return set(self.spot_indices.tolist()) == set(other.spot_indices.tolist())

    def explains_more(self, other: Acquisition) -> bool:
        """Whether it has a pose that shows all spots of the other and more."""
        if self.refined is None or self.spot_indices is None:
            return False
        theirs = () if other.spot_indices is None else other.spot_indices.tolist()
        return set(theirs) < set(self.spot_indices.tolist())

    def is_near(self, pose: Pose, centre_m: Array) -> bool:
        """Whether it has a pose near another: a tenth of the range, half a radian."""
        if self.refined is None:
            return False
        own = self.refined.camera_from_target
        where, was = own.apply(centre_m), pose.apply(centre_m)
        near = np.linalg.norm(where - was) < 0.1 * np.linalg.norm(was)
        return bool(near and own.angle_to(pose) < 0.5)

    def names(self, constellation: ReflectorPattern, count: int) -> tuple[str | None, ...]:
        """The reflector of every one of so many spots."""
        names: list[str | None] = [None] * count
        if self.reflectors is not None and self.spot_indices is not None:
            for reflector, spot in zip(self.reflectors, self.spot_indices, strict=True):
                names[spot] = constellation.names[reflector]
        return tuple(names)

    def table(self, spots: SpotTable, count: int) -> Array:
        """(N, COLUMNS) the spot of each of so many reflectors, NaN where it has none."""
        table = np.full((count, COLUMNS), np.nan)
        table[self.reflectors] = spots.table[self.spot_indices]
        return table
