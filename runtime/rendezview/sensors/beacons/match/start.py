"""Starting poses without a prior: from three lights.

The paper's tracker cannot find its target again once a sensor was lost. Here the starts are
the poses of every three lights in every single camera (P3P): a false light spoils only
some of them, and they need no second camera. All are judged by the collinearity equations
of all cameras, the best are refined, and every distinct answer is returned.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np

from rendezview.estimation.hypotheses import choose
from rendezview.estimation.p3p import MAX_ROOTS, solve_p3p_batch
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.pose.collinearity import solve
from rendezview.sensors.beacons.rig import Rig, Sights

# Of lights, for each camera: all of six lights'.
_MOST_TRIPLES = 20  # Source: by construction, 6 over 3
_REFINED = 12  # starts that are refined. Source: by construction, a bound of time
DISTINCT_RAD = np.deg2rad(3.0)  # rad; poses nearer than this are one. Source: by construction
# A pose of three lights fits the other lights so many times worse than σ. Source: by hand;
# stereo-accuracy (0.1) --part recovery finds all
NOISY_TIMES = 6.0
# sums of squares closer than this do not distinguish two minima. Source: by construction, odds of
# e⁷
_ALIKE = 15.0
# Squared residual of a light, at which it counts as false: 1 in 3 million by chance.
CAP = 30.0  # Source: χ² distribution, two degrees of freedom

Retrieval = tuple[Array, Array]  # (N, 3, 3) rotations and (N, 3) translations, rig from target
Triple = tuple[int, int, int]
_NO: Retrieval = (np.empty((0, 3, 3)), np.empty((0, 3)))  # Source: by construction


def candidates(rig: Rig, leds: Array, normals: Array, sights: Sights) -> list[tuple[Array, Array]]:
    """All distinct poses that the sights allow, rotation and translation, the likeliest first.

    The starts that fit best are iterated, false lights kept out. Empty where no camera sees three
    lights.

    Args:
        rig: the cameras.
        leds: (L, 3) lights in the target frame.
        normals: (L, 3) directions of their beams, zeros where not known.
        sights: identified lights.
    """
    parts = [_of_three_lights(rig, k, leds, sights) for k in range(len(rig))]
    rotations, translations = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(rotations):
        return []
    own = sights.xy.swapaxes(0, 1)[:, :, None], sights.weight.swapaxes(0, 1)[:, :, None]
    cost = misfits((rotations, translations), rig, leds, normals, own[0], own[1] / NOISY_TIMES)
    best = np.argsort(cost, kind="stable")[:_REFINED]
    rotations = np.ascontiguousarray(rotations[best])
    translations = np.ascontiguousarray(translations[best])
    with np.errstate(over="ignore", invalid="ignore"):  # where a pose runs away
        settle((rotations, translations), rig, leds, normals, sights)
        cost = misfits((rotations, translations), rig, leds, normals, *own)
    cost[~np.isfinite(rotations.sum(axis=(1, 2)) + translations.sum(axis=1))] = np.inf

    def same(one: int, other: int) -> bool:
        trace = np.vdot(rotations[one], rotations[other])
        return bool(trace >= 1.0 + 2.0 * np.cos(DISTINCT_RAD))

    found = choose(-cost, same, within=_ALIKE, most=len(cost))
    if found is None or not np.isfinite(cost[found.best]):
        return []
    return [(rotations[k], translations[k]) for k in found.answers]


def _of_three_lights(rig: Rig, camera: int, leds: Array, sights: Sights) -> Retrieval:
    """Every pose of every three lights (at most the 20 widest) that one camera sees."""
    visible, xy = np.flatnonzero(sights.visible[camera]).tolist(), sights.xy[camera]
    triples = list(itertools.combinations(visible, 3))
    if len(triples) > _MOST_TRIPLES:
        triples = widest(xy, triples)[:_MOST_TRIPLES]
    return p3p(rig, camera, [(leds[three], xy[three]) for three in map(list, triples)])


def widest(xy: Array, triples: list[Triple]) -> list[Triple]:
    """Triples of points by the area of their triangle, largest first."""
    corners = xy[np.array(triples, dtype=np.intp)]
    u, v = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = np.abs(u[0] * v[1] - u[1] * v[0])
    return [triples[i] for i in np.argsort(-area, kind="stable")]


def p3p(rig: Rig, camera: int, problems: Iterable[tuple[Array, Array]]) -> Retrieval:
    """rig_from_points of many three points (3, 3) at ideal places (3, 2): up to four each."""
    each = list(problems)
    if not each:
        return _NO
    points, xy = (np.array(part) for part in zip(*each, strict=True))
    rays = np.concatenate([xy, np.ones((len(xy), 3, 1))], axis=2)
    rotations, translations, counts = solve_p3p_batch(rays, points)
    found = np.arange(MAX_ROOTS) < counts[:, None]
    # The camera's own axes to the rig's
    rotation, translation = rig.rotations[camera].T, rig.translations[camera]
    return rotation @ rotations[found], (translations[found] - translation) @ rotation.T


def misfits(
    poses: Retrieval, rig: Rig, leds: Array, normals: Array, xy: Array, weight: Array
) -> Array:
    """(H,) sums over lights and cameras of the squared distance to the nearest spot, up to CAP.

    ``xy``, 1/σ: (C, S, 2) spots of any light, NaN where there is none, or (L, C, 1, 2) each light's
    own, of weight 0 where it is not visible.
    """
    nearest = np.fmin(np.fmin.reduce(squares(poses, rig, leds, normals, xy, weight), axis=3), CAP)
    hidden = (weight == 0.0).all(axis=(-2, -1))
    return np.asarray(np.where(hidden, 0.0, nearest).sum(axis=(1, 2)))


def squares(
    poses: Retrieval, rig: Rig, leds: Array, normals: Array, xy: Array, weight: Array
) -> Array:
    """(H, L, C, S) squared distances of spots and lights, infinite where a light does not show."""
    rotations, translations = poses
    turn = rotations.transpose(0, 2, 1)
    q = np.tensordot(leds @ turn + translations[:, None], rig.rotations, (2, 2)) + rig.translations
    beam = np.tensordot(normals @ turn, rig.rotations, (2, 2))  # (H, L, C, 3), as q
    front = (q[..., 2] > 1e-9) & ((beam * q).sum(axis=3) <= 0.0)
    at = q[..., :2] / np.where(front, q[..., 2], 1.0)[..., None]
    square = ((weight * (xy - at[..., None, :])) ** 2).sum(axis=4)
    return np.where(front[..., None], square, np.inf)


def settle(poses: Retrieval, rig: Rig, leds: Array, normals: Array, sights: Sights) -> None:
    """Iterate each pose, in place, with Geman's and McClure's weights, from loose to tight."""
    each = [part.swapaxes(0, 1)[:, :, None] for part in (sights.xy, sights.weight)]
    no_prior, information = (np.zeros((6, 6)), np.zeros((3, 3)), np.zeros(3)), np.empty((6, 6))
    for scale in (900.0, 200.0, 60.0, 20.0, 20.0, 20.0):
        share = scale / (scale + squares(poses, rig, leds, normals, *each)[..., 0])
        share[~(share > 1e-6)] = 0.0
        weights = sights.weight * share.swapaxes(1, 2)[..., None]
        for rotation, translation, weight in zip(*poses, weights, strict=True):
            solve(
                rotation, translation, leds, rig.rotations, rig.translations, sights.xy, weight,
                *no_prior, 4, 1e-3, information,
            )  # fmt: skip
