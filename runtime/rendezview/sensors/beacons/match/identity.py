"""Assigns spots to lights from geometry only: for lights that all shine at once.

Three spots of one camera, taken for any three lights, give a few poses (P3P); the right
one puts the other lights on spots in every camera. Close to a known pose the spots nearest
to the predicted places are enough.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from rendezview.geometry.pose import Array, Pose, rotation_angle
from rendezview.sensors.beacons.detect.detectors import UNKNOWN, Spots
from rendezview.sensors.beacons.match.acquisition_options import MIRRORED
from rendezview.sensors.beacons.match.agreement import Disagreement, LightsFit, agree
from rendezview.sensors.beacons.match.start import (
    CAP,
    DISTINCT_RAD,
    NOISY_TIMES,
    Retrieval,
    misfits,
    p3p,
    widest,
)
from rendezview.sensors.beacons.rig import Rig

_MOST_SPOTS = 40  # a camera that sees more sees no target. Source: by construction, a bound of time
_MOST_ASSIGNMENTS = 12_000  # Source: by construction, a bound of time
# over all cameras: four spots and four lights fit in too many ways. Source: by construction
_FEWEST_SPOTS = 5
_TRIPLES = 12  # of spots that are tried, the widest first. Source: by construction, a bound of time
_KEPT = 8  # Source: by construction, a bound of time

# Spots that a pose explains, its sum of squares, the numbered spots and the fit.
Answer = tuple[int, float, tuple[Spots, ...], LightsFit]


def nearest_lights(
    rig: Rig, leds: Array, normals: Array, spots: Sequence[Spots], pose: Pose, gate: float
) -> tuple[Spots, ...]:
    """The spots with the numbers of the lights that a pose puts closest to them.

    One spot for each light and the other way round, at least total distance (Hungarian);
    ``gate``: distance, normalised, beyond which a spot is no light.
    """
    from scipy.optimize import linear_sum_assignment  # slow to import

    named = []
    for camera, found in zip(rig.cameras, spots, strict=True):
        led = np.full(len(found), UNKNOWN)
        in_camera = camera.camera_from_rig @ pose
        points = in_camera.apply(leds)
        away = np.einsum("li,li->l", normals @ in_camera.rotation.T, points) > 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            predicted = points[:, :2] / points[:, 2:]
        apart = np.linalg.norm(camera.ideal(found)[0][:, None] - predicted[None], axis=2)
        apart[:, away | ~(points[:, 2] > 0.0)] = np.inf
        i, j = linear_sum_assignment(np.where(apart < gate, apart, 2.0 * gate))
        near = apart[i, j] < gate
        led[i[near]] = j[near]
        named.append(Spots(found.positions, found.sigma, led, found.brightness))
    return tuple(named)


def identify(
    rig: Rig, leds: Array, normals: Array, spots: Sequence[Spots]
) -> tuple[tuple[Spots, ...], LightsFit] | Disagreement:
    """Numbers of all spots and the pose that they give, without knowing either.

    Lights may be missing and spots may be none of the target's. Two poses that explain as
    many spots are an ambiguity, not an answer.
    """
    counts = [len(found) for found in spots]
    if max(counts) > _MOST_SPOTS:
        return Disagreement(f"{max(counts)} spots in one camera: that is more than the target")
    if max(counts) < 3 or sum(counts) < _FEWEST_SPOTS:
        return Disagreement(
            f"{' + '.join(map(str, counts))} spots: to identify them takes 3 in one camera "
            f"and {_FEWEST_SPOTS} in all"
        )
    answers = _answers(rig, leds, normals, spots)
    verdict = _verdict(answers)
    most = int(np.argmax(counts))
    if counts[most] >= _FEWEST_SPOTS and _mirrored(rig, most, leds, normals, spots, verdict):
        return Disagreement(MIRRORED)
    return verdict


def _mirrored(
    rig: Rig, k: int, leds: Array, normals: Array, spots: Sequence[Spots],
    verdict: tuple[tuple[Spots, ...], LightsFit] | Disagreement,
) -> bool:  # fmt: skip
    """Whether the target's mirror image explains more spots of camera ``k`` than the target."""
    explained = 0
    if not isinstance(verdict, Disagreement):
        left_out = {light for camera, light in verdict[1].left_out if camera == k}
        explained = int((verdict[0][k].led >= 0).sum()) - len(left_out)
    if explained >= min(len(spots[k]), len(leds)):
        return False
    image = np.array([-1.0, 1.0, 1.0])
    alone = Rig((rig.cameras[k],))
    theirs = _answers(alone, leds * image, normals * image, [spots[k]])
    return max((answer[0] for answer in theirs), default=0) > max(explained, _FEWEST_SPOTS - 1)


def _answers(rig: Rig, leds: Array, normals: Array, spots: Sequence[Spots]) -> list[Answer]:
    """Poses that explain spots, with how many; not sorted."""
    counts = [len(found) for found in spots]
    # (C, S, 2) ideal places, NaN where none, and 1/σ
    xy, weight = (
        np.full((len(spots), max(counts), 2), np.nan),
        np.zeros((len(spots), max(counts), 2)),
    )
    for k, found in enumerate(spots):
        ideal, sigma = rig.cameras[k].ideal(found)
        xy[k, : len(found)], weight[k, : len(found)] = ideal, 1.0 / sigma
    # Spread-out triples of the camera that sees the most; then the others.
    answers: list[Answer] = []
    tried, all_of_them = 0, min(sum(counts), len(rig) * len(leds))
    for k in np.argsort([-count for count in counts], kind="stable"):
        if counts[k] < 3:
            continue
        places = xy[k, : counts[k]]
        good = np.flatnonzero(np.isfinite(places).all(axis=1)).tolist()
        orders = list(itertools.permutations(range(len(leds)), 3))
        for three in widest(places, list(itertools.combinations(good, 3)))[:_TRIPLES]:
            poses = p3p(rig, int(k), ((leds[list(o)], places[list(three)]) for o in orders))
            if len(poses[0]):
                _explain(rig, leds, normals, spots, xy, weight, poses, answers)
            tried += len(orders)
            explained = max((answer[0] for answer in answers), default=0)
            if explained >= all_of_them or tried > _MOST_ASSIGNMENTS:
                return answers
    return answers


def _explain(
    rig: Rig,
    leds: Array,
    normals: Array,
    spots: Sequence[Spots],
    xy: Array,
    weight: Array,
    poses: Retrieval,
    answers: list[Answer],
) -> None:
    """Judge poses by the spots they explain; the best are refined and added to the answers."""
    rotations, translations = poses
    misfit = misfits(poses, rig, leds, normals, xy, weight / NOISY_TIMES)
    coarse = 2.0 * np.sqrt(CAP) * NOISY_TIMES / np.median(weight[weight > 0.0])
    for i in np.argsort(misfit, kind="stable")[:_KEPT]:
        pose, gate = Pose(rotations[i], translations[i]), coarse
        fit: LightsFit | Disagreement | None = None
        numbered: tuple[Spots, ...] = ()
        for _ in range(3):
            numbered = nearest_lights(rig, leds, normals, spots, pose, gate)
            sights = rig.sights(numbered, len(leds))
            if sights.visible.sum() < _FEWEST_SPOTS:
                fit = None
                break
            fit = agree(rig, leds, sights, pose.rotation, pose.translation_m)
            if isinstance(fit, Disagreement):
                break
            pose, gate = Pose(fit.rotation, fit.translation), 0.25 * coarse
        if isinstance(fit, LightsFit):
            explained = int(sights.visible.sum()) - len(fit.left_out)
            answers.append((explained, fit.cost, numbered, fit))


def _verdict(
    answers: list[Answer],
) -> tuple[tuple[Spots, ...], LightsFit] | Disagreement:
    if not answers:
        return Disagreement("no assignment of spots to lights fits the target")
    answers.sort(key=lambda answer: (-answer[0], answer[1]))
    explained, cost, numbered, fit = answers[0]
    if explained < _FEWEST_SPOTS:
        return Disagreement(f"only {explained} spots fit the target: too few to be confident")
    for other in answers[1:]:
        apart = rotation_angle(other[3].rotation @ fit.rotation.T) > DISTINCT_RAD
        # A spot more explained is worth CAP; less than that is no proof.
        if apart and other[1] - cost + CAP * (explained - other[0]) < 0.5 * CAP:
            return Disagreement(
                f"two poses explain {explained} and {other[0]} spots: they cannot be distinguished",
                ambiguous=True,
            )
    return numbered, fit
