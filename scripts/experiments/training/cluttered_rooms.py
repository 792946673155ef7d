"""What is around a target on the ground: rooms behind it, other bodies, hands before it.

The target stays the largest body. Source of all numbers: by construction of the training set of
the sketch network.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from experiments.training.random_textures import random_texture, scatter_shapes
from experiments.training.sketch_frames import CraftDrawing
from rendezview.geometry.zbuffer import Float32s
from rendezview.sensors.appearance.model.sketches import COVER
from rendezview_ground.simulate.hard_light import HardLightOptions

# Lamps and windows light a room from many sides, and cameras expose it for its middle.
INDOORS = HardLightOptions(
    ambient=(0.05, 3.0), shade_share=0.2, level_grey=(25.0, 500.0), dark_share=0.05,
    sky_share=1.0, terminator_share=0.0, sky_level_grey=(25.0, 400.0), dust_share=0.1,
    wrinkles_share=0.1, patches_depth=(0.02, 0.25), bloom_share=0.3, stray_share=0.1,
    noise_sigma_grey=(0.25, 3.0),
)  # fmt: skip
_LARGEST_OTHER = 0.4  # of the target's area in the picture
_LEAST_VISIBLE = 0.6  # of the target beside what is before it


def room(side: int, rng: np.random.Generator) -> Float32s:
    """(S, S) radiance of a wall, mostly with a table, a plate on it, and clutter; 1 is bright."""
    picture = random_texture(side, rng) if rng.random() < 0.6 else np.full(
        (side, side), rng.uniform(0.05, 1.0), np.float32)  # fmt: skip
    if rng.random() < 0.5:
        scatter_shapes(picture, int(rng.integers(1, 15)), rng)
    if rng.random() < 0.8:
        far = rng.uniform(-0.2, 0.8) * side
        _lay(picture, _plane(side, far, rng), rng)
    if rng.random() < 0.4:
        mask = np.zeros((side, side), np.float32)
        centre = (side * rng.uniform(0.3, 0.7, 2)).astype(int).tolist()
        axes = (side * rng.uniform(0.15, 0.6) * np.array([1.0, rng.uniform(0.3, 1.0)])).astype(int)
        turn = float(rng.uniform(-20.0, 20.0))
        if rng.random() < 0.5:
            cv2.ellipse(mask, centre, axes.tolist(), turn, 0.0, 360.0, 1.0, -1, cv2.LINE_AA)
        else:
            plate = cv2.boxPoints((tuple(map(float, centre)), tuple(2.0 * axes), turn))
            moved = 0.3 * axes * np.array([rng.uniform(-1.0, 1.0, 2), *np.zeros((3, 2))])
            cv2.fillPoly(mask, [(plate + moved).astype(np.int32)], 1.0, cv2.LINE_AA)
        _lay(picture, mask, rng)
    if rng.random() < 0.7:
        scatter_shapes(picture, int(rng.integers(1, 20)), rng)
    shade = cv2.resize(rng.uniform(0.3, 1.0, (3, 3)).astype(np.float32), (side, side),
                       interpolation=cv2.INTER_CUBIC)  # fmt: skip
    picture *= np.maximum(shade, 0.1)
    if rng.random() < 0.6:
        sigma_px = float(np.exp(rng.uniform(np.log(0.4), np.log(6.0))))
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px))
    bright = max(float(np.percentile(picture, 99.0)), 0.05)
    return np.asarray(picture / bright, dtype=np.float32)


def crowded(
    drawing: CraftDrawing, others: Sequence[CraftDrawing], rng: np.random.Generator
) -> CraftDrawing:
    """The target with smaller bodies behind it, and sometimes a hand or a bar before it.

    Its maps show what of it stays visible. What hides it has no edges in them.
    """
    cover = drawing.maps[COVER].astype(np.float32) / 255.0
    light, covered = drawing.light.astype(np.float32), cover
    for other in others:
        theirs, their_light = _elsewhere(other, cover, rng)
        light = light + (1.0 - covered) * their_light
        covered = covered + (1.0 - covered) * theirs
    maps = drawing.maps
    hidden, level = _before(cover, light, rng)
    if (cover * (1.0 - hidden)).sum() > _LEAST_VISIBLE * cover.sum():
        maps = np.rint(maps * (1.0 - hidden)).astype(np.uint8)
        light = light * (1.0 - hidden) + level * hidden
        covered = covered + (1.0 - covered) * hidden
    whole = np.rint(255.0 * covered).astype(np.uint8)
    return CraftDrawing(maps, light.astype(np.float16), whole)


def _plane(side: int, far: float, rng: np.random.Generator) -> Float32s:
    """(S, S) coverage by a plane that reaches from its far edge to the viewer."""
    mask = np.zeros((side, side), np.float32)
    tilt = rng.uniform(-0.2, 0.2) * side
    left, right = sorted(rng.uniform(-0.6, 1.6, 2) * side)
    if right - left < 0.4 * side or rng.random() < 0.5:
        left, right = -side, 2 * side
    corners = [[left, far - tilt], [right, far + tilt], [2 * side, 2 * side], [-side, 2 * side]]
    cv2.fillPoly(mask, [np.array(corners).astype(np.int32)], 1.0, cv2.LINE_AA)
    return mask


def _lay(picture: Float32s, mask: Float32s, rng: np.random.Generator) -> None:
    """Cover a part of the picture with a texture in perspective, in place."""
    side = len(picture)
    levels = np.full((side, side), rng.uniform(0.02, 1.0), np.float32)
    if rng.random() < 0.6:
        square = side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        top, narrow = rng.uniform(-0.2, 0.7), rng.uniform(0.1, 0.9)
        quad = [[0.5 - narrow, top], [0.5 + narrow, top], [2.5, 1.3], [-1.5, 1.3]]
        shifted = (side * (np.array(quad) + rng.uniform(-0.2, 0.2, (4, 2)))).astype(np.float32)
        warp = cv2.getPerspectiveTransform(square, shifted)
        texture = random_texture(side, rng)
        levels = np.asarray(
            cv2.warpPerspective(texture, warp, (side, side), borderMode=cv2.BORDER_REFLECT)
        )
    picture += mask * (levels - picture)


def _elsewhere(
    other: CraftDrawing, cover: Float32s, rng: np.random.Generator
) -> tuple[Float32s, Float32s]:
    """Cover (S, S) and light (2, S, S) of another body, smaller than the target, anywhere."""
    side = len(cover)
    theirs = other.maps[COVER].astype(np.float32) / 255.0
    scale = np.sqrt(rng.uniform(0.05, _LARGEST_OTHER) * cover.sum() / max(theirs.sum(), 1.0))
    turn = cv2.getRotationMatrix2D((0.5 * side, 0.5 * side), rng.uniform(0.0, 360.0), min(scale, 2))
    turn = turn + np.outer(rng.uniform(-0.5, 0.5, 2) * side, [0.0, 0.0, 1.0])
    planes = [theirs, *other.light.astype(np.float32) * np.exp(rng.uniform(-1.5, 1.0))]
    moved = [cv2.warpAffine(plane, turn, (side, side), flags=cv2.INTER_AREA) for plane in planes]
    return np.asarray(moved[0]), np.asarray(moved[1:])


def _before(
    cover: Float32s, light: Float32s, rng: np.random.Generator
) -> tuple[Float32s, Float32s]:
    """Coverage (S, S) by fingers, a bar or a blot before the target, and its light (2, S, S)."""
    side = len(cover)
    mask, kind = np.zeros((side, side), np.uint8), rng.integers(4)
    target = np.argwhere(cover > 0.5)[:, ::-1]
    if kind < 2:  # from a border to a few places of the target
        start = rng.uniform(-0.2, 1.2, 2) * side
        start[rng.integers(2)] = rng.choice([-0.2, 1.2]) * side
        width = rng.uniform(0.03, 0.13) * side
        end = target[rng.integers(len(target))]
        for k in range(int(rng.integers(1, 5))):
            aside = 1.1 * k * width * np.array([start[1] - end[1], end[0] - start[0]])
            aside /= max(float(np.hypot(*(end - start))), 1.0)
            knee = 0.5 * (start + end) + aside + rng.uniform(-0.1, 0.1, 2) * side
            last = end + aside + rng.uniform(-0.05, 0.05, 2) * side
            line = np.array([start + aside, knee, last]).astype(np.int32)
            cv2.polylines(mask, [line], False, 255, int(width), cv2.LINE_AA)
    elif kind == 2:
        middle, along = target[rng.integers(len(target))], 2 * side * rng.standard_normal(2)
        first, last = ((middle + way * along).astype(int).tolist() for way in (-1.0, 1.0))
        cv2.line(mask, first, last, 255, max(1, int(rng.uniform(0.01, 0.1) * side)), cv2.LINE_AA)
    elif kind == 3 and rng.random() < 0.5:
        centre = target[rng.integers(len(target))]
        corners = centre + rng.uniform(0.05, 0.3) * side * rng.standard_normal((7, 2))
        cv2.fillPoly(mask, [cv2.convexHull(corners.astype(np.int32))], 255, cv2.LINE_AA)
    # Fingers are round: brighter in the middle.
    depth = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 3)
    roundness = np.sqrt(depth / max(float(depth.max()), 1.0))
    level = float(light[0][cover > 0.5].mean()) * np.exp(rng.uniform(-1.5, 1.5))
    shade = level * (rng.uniform(0.3, 1.0) + 0.5 * roundness)
    return mask.astype(np.float32) / 255.0, np.stack([shade, shade])
