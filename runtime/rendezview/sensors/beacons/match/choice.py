"""The choice among candidate poses: the one that explains most spots, if no other comes near.

Several poses may show the same spots: three reflectors in one plane often have two poses that
face the camera, and other three of the target may pass for them. All are kept until other spots,
sizes or the last pose tell them apart; otherwise the picture is ambiguous.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import hat
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.cover import compare_spots
from rendezview.sensors.beacons.detect.discs import camera_numbers
from rendezview.sensors.beacons.detect.spots import SpotTable
from rendezview.sensors.beacons.match.acquisition_options import Acquisition, AcquisitionOptions
from rendezview.sensors.beacons.match.judgement import least_facing
from rendezview.sensors.beacons.match.matching import match_all, size_score
from rendezview.sensors.beacons.match.mirrored_pose import mirror
from rendezview.sensors.beacons.pose.refinement import Refined, SpotFit, loose_px
from rendezview.sensors.observation import Status

Ints = npt.NDArray[np.int64]

# Candidates that are matched to all spots, and hypotheses that are refined, the best first.
# Source: by construction, 10 triangles × 10 triplets of five reflectors × 2
_MOST_MATCHED = 200
_MOST_REFINED = 40  # Source: experiment reflector-hidden --seed 1
# rad, and share of the range: poses nearer than this are one. Source: by construction, the error at
# 8 m
_SAME = 0.02
_PRIOR = 0.35  # rad and share: the last pose chooses one this near. Source: by construction, 20°
_PRIOR_RATIO = 3.0  # … and nearer by this factor than any other. Source: by construction
# Of so few spots of a target with more, a pose tilted further may be chance's. Source: experiment
# reflector-hidden, seed 21
_STEEP = math.cos(math.radians(54.0))
FEW = 4  # spots that hardly contradict wrong names. Source: by construction, 8 numbers for 6


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Poses of triplets of spots, the best first."""

    rows: Ints  # (K, 5) number of the triangle, its group, and spots left, centre, right
    scores: Array  # (K,) χ²
    poses: Array  # (K, 12) rotation and translation


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    refined: Refined
    group: int
    which: Ints  # (N,) reflectors
    where: Ints  # (N,) their spots
    score: float  # χ² of the triplet
    total: float  # χ² of all its spots: sizes, and places where there are more than three
    dropped: tuple[tuple[int, int], ...] = ()  # reflectors and the spots near them that do not fit

    @property
    def pose(self) -> Pose:
        return self.refined.camera_from_target

    @property
    def spots(self) -> frozenset[int]:
        return frozenset(self.where.tolist())


class Chooser:
    """Chooses for one camera and the groups of one target."""

    def __init__(
        self,
        camera: Camera,
        patterns: list[ReflectorPattern],
        constellation: ReflectorPattern,
        options: AcquisitionOptions,
    ) -> None:
        self.camera, self.options, self.constellation = camera, options, constellation
        self._names = [p.name for p in patterns]
        # Turned by one of these a group looks the same.
        self._turns = [[Pose.identity(), *p.turns()] for p in patterns]
        self._bases = [p.positions_m[p.base[1]] - p.positions_m[p.base[0]] for p in patterns]
        self._group_of = np.repeat(np.arange(len(patterns)), [len(p) for p in patterns])
        # A triangle's own group first: of two reflectors in one place it has the better claim.
        self._orders = np.array(
            [np.argsort(self._group_of != g, kind="stable") for g in range(len(patterns))]
        )
        self._lens = camera_numbers(camera, options.blur_px)
        self._fit = SpotFit(camera, constellation, options.blur_px).fit

    def choose(
        self, spots: SpotTable, usable: Ints, candidates: Candidates, prior: Pose | None
    ) -> Acquisition:
        """Of the candidates the one that explains most spots best, unless another comes close."""
        options, scores = self.options, candidates.scores
        triplets = np.sort(candidates.rows[:, 2:], axis=1)
        redundant = len(self.constellation) > 3
        if not redundant:
            # No candidate can explain more spots: only those of the best three are looked at.
            same = (triplets == triplets[0]).all(axis=1)
            found = self._hypotheses(spots, usable, candidates, np.flatnonzero(same))
        else:
            found = self._hypotheses(spots, usable, candidates, np.arange(len(scores)))
        if not found:
            return Acquisition(
                Status.NOT_FOUND, "three spots pass for the target, but no pose fits them"
            )
        most = max(len(h.which) for h in found)
        found = [h for h in found if len(h.which) == most]
        found.sort(key=lambda h: h.total)
        best = found[0]
        others = ~np.isin(triplets, best.where).all(axis=1)
        if not redundant and others.any():
            rival = float(scores[others].min())
            if rival - best.score < options.rival_margin:
                return self._ambiguous(
                    best,
                    f"two sets of spots pass for the target (χ² {best.score:.1f} and {rival:.1f}): "
                    "give a prior, or look again",
                )
        if most == 3 and (
            float(others.sum()) * (best.score / options.score_limit) ** 2.5 > options.chance
        ):
            reason = (
                f"{int(others.sum())} other sets of spots pass for the target too, so that the "
            )
            reason += f"best (χ² {best.score:.1f}) may be chance: give a prior, or look again"
            return self._ambiguous(best, reason)
        if redundant and most == 3 and prior is None:
            # Only three of more: a false spot may stand for a hidden reflector.
            strangers = self._strangers(spots, usable, best)
            if strangers or best.score > options.sparse_limit:
                return self._ambiguous(
                    best,
                    f"three spots pass for {len(self.constellation)} reflectors (χ² "
                    f"{best.score:.1f}), {strangers} spots like them do not fit: uncover more "
                    "reflectors, give a prior, or look again",
                )
        near = [h for h in found if h.total - best.total < options.pose_margin]
        chosen = self._one_of(near, prior)
        if chosen is None:
            count = sum(not self._alike(h, best) for h in near)
            return self._ambiguous(
                best,
                f"{count + 1} poses show the same {most} spots as well (χ² {best.total:.1f} and "
                f"{next(h.total for h in near if not self._alike(h, best)):.1f}): uncover more "
                "reflectors, give a prior, or look again",
            )
        if chosen.dropped and most <= FEW:
            # Neighbours that are named wrongly fit too, if another spot gives way.
            return self._ambiguous(
                best,
                f"{most} spots fit, {self._aside(chosen, spots)} does not: its place in the target "
                "file, names or spots may be wrong; measure it, give its position_sigma_m, or show "
                "more reflectors",
            )
        if redundant and most <= FEW and prior is None and not self._faces(chosen, _STEEP):
            reason = f"{most} spots show a steeply tilted target, or are chance: uncover more"
            return self._ambiguous(best, f"{reason} reflectors, give a prior, or look again")
        groups = set(self._group_of[chosen.which].tolist())
        ambiguous = prior is None and len(groups) == 1 and len(self._turns[chosen.group]) > 1
        return Acquisition(
            Status.OK, None, chosen.refined, self._names[chosen.group], chosen.which,
            chosen.where, chosen.score, ambiguous,
        )  # fmt: skip

    def _aside(self, hypothesis: _Hypothesis, spots: SpotTable) -> str:
        """The reflectors whose spots do not fit, and how far off, across the view, in words."""
        words, pose = [], hypothesis.pose
        for k, spot in hypothesis.dropped:
            place = pose.apply(self.constellation.positions_m[k])
            off = self.camera.rays(spots.table[[spot], :2])[0] * place[2] - place
            name, off_mm = self.constellation.names[k], 1e3 * float(np.linalg.norm(off))
            words.append(f"that of {name!r}, {off_mm:.1f} mm aside,")
        return " ".join(words)

    def _ambiguous(self, best: _Hypothesis, reason: str) -> Acquisition:
        """No pose, but the spots and the group of the best one: see `Acquirer.acquire`."""
        return Acquisition(
            Status.AMBIGUOUS, reason, group=self._names[best.group], spot_indices=best.where,
            score=best.score,
        )  # fmt: skip

    def _strangers(self, spots: SpotTable, usable: Ints, best: _Hypothesis) -> int:
        """How many spots as large as those of a hypothesis it leaves over."""
        sizes = np.log(spots.size_px)
        rest = np.setdiff1d(usable, best.where)
        low, high = sizes[best.where].min(), sizes[best.where].max()
        slack = 2.0 * self.options.size_limit
        return int(np.sum((sizes[rest] > low - slack) & (sizes[rest] < high + slack)))

    def _one_of(self, near: list[_Hypothesis], prior: Pose | None) -> _Hypothesis | None:
        """The hypothesis that all others are alike, or that the last pose points at."""
        if prior is not None:
            steps = sorted((self._apart(h.pose, prior), k) for k, h in enumerate(near))
            first = near[steps[0][1]]
            others = [a for a, k in steps if self._apart(near[k].pose, first.pose) > _SAME]
            if not others or (steps[0][0] < _PRIOR and others[0] > _PRIOR_RATIO * steps[0][0]):
                return first
            # A half turn that looks the same is no question of the prior's precision.
            if all(self._alike(h, first) for h in near):
                return first
            return None
        if any(not self._alike(h, near[0]) for h in near):
            return None
        along = self._bases[near[0].group]
        return min(near, key=lambda h: -float(h.pose.rotation[0] @ along))  # the least roll

    def _apart(self, pose: Pose, other: Pose) -> float:
        """How far two poses are apart: rad of turn, and move as a share of the range, squared."""
        centre = self.constellation.centre_m
        here, there = pose.apply(centre), other.apply(centre)
        share = float(np.linalg.norm(here - there) / np.linalg.norm(there))
        return math.hypot(pose.angle_to(other), share)

    def looks_like(self, refined: Refined, which: Ints, pose: Pose, least: float = 0.1) -> bool:
        """Whether a pose is the refined one, or one that a symmetry of its group shows.

        Both turn (rad) and move (share of the range) must be below ``least``, or below 4 σ.
        """
        sigma = 4.0 * math.sqrt(float(np.trace(refined.covariance[:3, :3])))
        groups = set(self._group_of[which].tolist())
        turns = self._turns[groups.pop()] if len(groups) == 1 else [Pose.identity()]
        found = refined.camera_from_target
        # The place of its own reflectors: that of the target's origin moves with each turn.
        centre = self.constellation.positions_m[which].mean(axis=0)
        here = pose.apply(centre)
        moved = 4.0 * math.sqrt(self._spread(refined, found.rotation @ centre))
        limit = max(least * float(np.linalg.norm(here)), moved)
        return any(
            (found @ turn).angle_to(pose) < max(least, sigma)
            and float(np.linalg.norm((found @ turn).apply(centre) - here)) < limit
            for turn in turns
        )

    @staticmethod
    def _spread(refined: Refined, arm: Array) -> float:
        """Variance, m², of the place of a point ``arm`` (3,) from the target's origin."""
        lever = np.hstack([-hat(arm), np.eye(3)])
        return float(np.trace(lever @ refined.covariance @ lever.T))

    def _alike(self, one: _Hypothesis, other: _Hypothesis) -> bool:
        """Whether two hypotheses are one pose, or one that a symmetry of their group shows."""
        return one.spots == other.spots and self.looks_like(
            one.refined, one.which, other.pose, _SAME
        )

    def _hypotheses(
        self, spots: SpotTable, usable: Ints, candidates: Candidates, chosen: Ints
    ) -> list[_Hypothesis]:
        """Refined poses of the candidates that most spots agree with, without repetitions."""
        chosen = chosen[:_MOST_MATCHED]
        numbers, poses = [], []
        for k in chosen:
            rotation = candidates.poses[k, :9].reshape(3, 3)
            pose = Pose.unchecked(rotation, candidates.poses[k, 9:])
            for turn in self._turns[candidates.rows[k, 1]]:
                numbers.append(int(k))
                poses.append(pose @ turn)
        n, pattern = len(self.constellation), self.constellation
        which, where = np.empty((len(poses), n), np.int64), np.empty((len(poses), n), np.int64)
        counts = np.empty(len(poses), np.int64)
        match_all(
            self._lens, pattern.positions_m, pattern.normals, pattern.diameters_m,
            np.array([np.append(p.rotation.ravel(), p.translation_m) for p in poses]),
            self.camera.fx, self.options.blur_px, self._orders[candidates.rows[numbers, 1]],
            spots.table, usable, np.ascontiguousarray(candidates.rows[numbers, 2:]),
            (self.options.match_px, 2.0 * self.options.size_limit), counts, which, where,
        )  # fmt: skip
        made: list[_Hypothesis] = []
        seen: list[tuple[bytes, Pose]] = []
        for k in np.argsort(-counts, kind="stable"):
            count = int(counts[k])
            if count < 3 or (made and count < len(made[0].which)) or len(seen) >= _MOST_REFINED:
                break
            key = which[k, :count].tobytes() + where[k, :count].tobytes()
            if any(key == other and poses[k].angle_to(p) < 3 * _SAME for other, p in seen):
                continue
            seen.append((key, poses[k]))
            row = numbers[k]
            group, score = int(candidates.rows[row, 1]), float(candidates.scores[row])
            names, places = which[k, :count], where[k, :count]
            hypothesis = self._refined(spots, names, places, poses[k], group, score)
            if hypothesis is None:
                continue
            made.append(hypothesis)
            if count > 3:  # three have all their poses from P3P
                mirrored = mirror(hypothesis.pose, pattern, names)
                other = self._refined(spots, names, places, mirrored, group, score)
                if other is not None and self._faces(other, self.options.least_cosine):
                    made.append(other)
            made.sort(key=lambda h: -len(h.which))
        return made

    def _faces(self, hypothesis: _Hypothesis, least_cosine: float) -> bool:
        """Whether all reflectors of a hypothesis face the camera so much."""
        which, pattern, pose = hypothesis.which, self.constellation, hypothesis.pose
        return bool(
            least_facing(
                pose.rotation.copy(), pose.translation_m.copy(),
                pattern.positions_m[which], pattern.normals[which],
            )
            > least_cosine
        )  # fmt: skip

    def _refined(
        self, spots: SpotTable, which: Ints, where: Ints, pose: Pose, group: int, score: float
    ) -> _Hypothesis | None:
        """Least squares on the spots of a hypothesis; a spot out of the gate is dropped."""
        options, pattern = self.options, self.constellation
        dropped: list[tuple[int, int]] = []
        while True:
            sigma = np.maximum(spots.sigma_px[where], 1e-3)
            cover, unsure, _ = compare_spots(
                spots.table[where], pattern, which, pose, self.camera.fx, options.blur_px
            )
            sigma = np.sqrt(sigma**2 + cover**2 + unsure**2)
            clipped = bool((spots.saturated_px[where] > 1).all())
            refined = self._fit(spots.table[where, :2], which, pose, sigma, saturated=clipped)
            if refined is None:
                return None
            if len(which) == 3:
                return _Hypothesis(refined, group, which, where, score, score, tuple(dropped))
            whole = np.hypot(sigma, options.gate_px + options.gate_size * spots.size_px[where])
            whole = np.hypot(whole, loose_px(pattern, refined, which, self.camera.fx))
            off = np.abs(refined.residuals_px).max(axis=1) / whole
            if off.max() < options.gate_sigma:
                break
            worst = self._worst(spots, which, where, refined.camera_from_target, whole)
            dropped.append((int(which[worst]), int(where[worst])))
            which, where = np.delete(which, worst), np.delete(where, worst)
        found = refined.camera_from_target
        sizes = size_score(
            pattern.positions_m[which], pattern.normals[which], pattern.diameters_m[which],
            found.rotation.copy(), found.translation_m.copy(),
            self.camera.fx, options.blur_px, spots.size_px[where],
            (options.size_sigma, options.diameter_sigma, options.blur_sigma),
        )  # fmt: skip
        places = float(np.sum((refined.residuals_px / whole[:, None]) ** 2))
        return _Hypothesis(refined, group, which, where, score, sizes + places, tuple(dropped))

    def _worst(self, spots: SpotTable, which: Ints, where: Ints, pose: Pose, sigma: Array) -> int:
        """The spot without which the others agree best: a fit leans towards one that is aside."""
        costs = []
        for k in range(len(which)):
            rest, own = np.delete(which, k), np.delete(where, k)
            left = np.delete(sigma, k)
            trial = self._fit(spots.table[own, :2], rest, pose, left)
            off = np.inf if trial is None else trial.residuals_px / left[:, None]
            costs.append(float(np.sum(np.square(off))))
        return int(np.argmin(costs))
