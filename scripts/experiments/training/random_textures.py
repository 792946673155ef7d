"""Random flat patterns: printed paper, tiles, wood, stone. Source of all numbers: by construction
of the training set of the sketch network.
"""

from __future__ import annotations

import cv2
import numpy as np

from experiments.training.random_skies import random_sky
from rendezview.geometry.zbuffer import Float32s

_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)
_LETTERS = np.array(list("abcdefghiklmnoprstuvwxyzABCDEFGHIKLMNOPRSTUVWXYZ0123456789"))


def random_texture(side: int, rng: np.random.Generator) -> Float32s:
    """(S, S) reflectance 0.02 … 1 of a flat surface."""
    kind = rng.choice(4, p=(0.4, 0.2, 0.2, 0.2))
    if kind == 0:
        picture = _printed(side, rng)
    elif kind == 1:
        picture = _tiles(side, rng)
    elif kind == 2:  # wood: a strip drawn out
        strip = random_sky(side, max(8, side // int(rng.integers(4, 33))), rng)
        picture = np.asarray(cv2.resize(strip, (side, side), interpolation=cv2.INTER_CUBIC))
    else:
        picture = random_sky(side, side, rng)
    low, high = sorted(rng.uniform(0.02, 1.0, 2))
    least, most = np.percentile(picture, (1.0, 99.0))
    shares = (picture - least) / max(float(most - least), 1e-3)
    return np.asarray(np.clip(low + (high - low) * shares, 0.02, 1.0), dtype=np.float32)


def scatter_shapes(picture: Float32s, count: int, rng: np.random.Generator) -> None:
    """Draw polygons, ellipses and lines of any level 0 … 1 into a picture (S, S), in place."""
    side = len(picture)
    for _ in range(count):
        level, kind = float(rng.random()), rng.integers(4)
        centre, size = rng.uniform(0.0, side, 2), side * np.exp(rng.uniform(-4.0, -0.8))
        if kind == 0:
            corners = centre + size * rng.uniform(-1.0, 1.0, (int(rng.integers(3, 7)), 2))
            hull = cv2.convexHull(corners.astype(np.int32))
            cv2.fillPoly(picture, [hull], level, cv2.LINE_AA)
        elif kind == 1:
            box = (tuple(map(float, centre)), tuple(map(float, size * rng.uniform(0.3, 2.0, 2))),
                   float(rng.uniform(0.0, 180.0)))  # fmt: skip
            cv2.fillPoly(picture, [cv2.boxPoints(box).astype(np.int32)], level, cv2.LINE_AA)
        elif kind == 2:
            axes = np.maximum(size * rng.uniform(0.3, 1.0, 2), 1.0).astype(int)
            thickness = -1 if rng.random() < 0.6 else int(rng.integers(1, 6))
            cv2.ellipse(picture, centre.astype(int).tolist(), axes.tolist(),
                        float(rng.uniform(0.0, 180.0)), 0.0, 360.0, level, thickness)  # fmt: skip
        else:
            ends = (centre + 3.0 * size * rng.uniform(-1.0, 1.0, (2, 2))).astype(int).tolist()
            cv2.line(picture, ends[0], ends[1], level, int(rng.integers(1, 9)), cv2.LINE_AA)


def _printed(side: int, rng: np.random.Generator) -> Float32s:
    """Paper with lines of letters in a few sizes, and shapes."""
    paper, ink = (0.9, 0.1) if rng.random() < 0.6 else rng.random(2)
    picture = np.full((side, side), paper, np.float32)
    if rng.random() < 0.7:
        scatter_shapes(picture, int(rng.integers(1, 12)), rng)
    page = np.asarray(cv2.convertScaleAbs(picture, alpha=255.0))
    top = 0.0
    while top < side:
        scale = float(np.exp(rng.uniform(-1.3, 1.0)))
        font, thickness = int(rng.choice(_FONTS)), int(rng.integers(1, 4))
        for _ in range(int(rng.integers(1, 6))):
            top += 30.0 * scale
            text = "".join(rng.choice(_LETTERS, int(rng.integers(2, 5 + int(30 / scale)))))
            place = int(rng.uniform(-0.1, 0.5) * side), int(top)
            cv2.putText(page, text, place, font, scale, 255.0 * ink, thickness, cv2.LINE_AA)
        top += rng.uniform(0.0, 0.3) * side
    return page.astype(np.float32)


def _tiles(side: int, rng: np.random.Generator) -> Float32s:
    """Stripes, a chequered pattern, or tiles with joints."""
    periods = side / np.exp(rng.uniform(np.log(2.0), np.log(30.0), 2))
    y, x = np.mgrid[0:side, 0:side].astype(np.float32)
    column, row = x / periods[0], y / periods[1]
    kind = rng.integers(3)
    if kind == 0:
        return np.asarray((column % 1.0) < rng.uniform(0.2, 0.8), dtype=np.float32)
    if kind == 1:
        return np.asarray((np.floor(column) + np.floor(row)) % 2.0, dtype=np.float32)
    joint = rng.uniform(0.02, 0.15)
    levels = rng.uniform(0.5, 1.0, (64, 64)).astype(np.float32)
    tiles = levels[row.astype(int) % 64, column.astype(int) % 64]
    joints = (column % 1.0 < joint) | (row % 1.0 < joint)
    return np.asarray(np.where(joints, 0.1, tiles), dtype=np.float32)
