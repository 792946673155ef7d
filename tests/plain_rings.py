"""Plain pictures of vehicles with round parts about one axis: numpy, and no code of the product.

A ray from every pixel meets rings of a plane, cones about the axis and flat rectangles; the nearest
counts. Matt surfaces, one Sun with hard shadows, even light besides. Pixels on an outline or at the
border of a shadow get ``FINE`` × ``FINE`` rays. Heights are along the axis, towards the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from tests.plain_pictures import Pinhole, turn

FINE = 3
_NEAR_M = 1e-4  # a shadow ray starts so far off its surface


def _across(
    height_m: float, aside_m: tuple[float, float], origin: np.ndarray, way: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (N,) to a plane across the axis, and places x, y (N,) from a part's middle."""
    far = (height_m - origin[:, 2]) / way[:, 2]
    x = origin[:, 0] + far * way[:, 0] - aside_m[0]
    y = origin[:, 1] + far * way[:, 1] - aside_m[1]
    return far, x, y


@dataclass(frozen=True)
class Annulus:
    """A flat ring of a plane across the axis; ``inner_m`` 0: a disc."""

    height_m: float
    inner_m: float
    outer_m: float
    grey: float
    aside_m: tuple[float, float] = (0.0, 0.0)

    def meet(self, origin: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,), inf for none, and normals (N, 3)."""
        far, x, y = _across(self.height_m, self.aside_m, origin, way)
        off2 = x * x + y * y
        good = (off2 >= self.inner_m**2) & (off2 <= self.outer_m**2) & (far > _NEAR_M)
        return np.where(good, far, np.inf), np.broadcast_to([0.0, 0.0, 1.0], way.shape)


@dataclass(frozen=True)
class Rectangle:
    """A flat rectangle of a plane across the axis."""

    height_m: float
    half_m: tuple[float, float]
    grey: float
    aside_m: tuple[float, float] = (0.0, 0.0)

    def meet(self, origin: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,), inf for none, and normals (N, 3)."""
        far, x, y = _across(self.height_m, self.aside_m, origin, way)
        good = (np.abs(x) <= self.half_m[0]) & (np.abs(y) <= self.half_m[1]) & (far > _NEAR_M)
        return np.where(good, far, np.inf), np.broadcast_to([0.0, 0.0, 1.0], way.shape)


@dataclass(frozen=True)
class Cone:
    """The side of a cone or cylinder about the axis, between two heights."""

    low_m: float
    low_radius_m: float
    high_m: float
    high_radius_m: float
    grey: float

    def meet(self, origin: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,), inf for none, and normals (N, 3) outwards."""
        slope = (self.high_radius_m - self.low_radius_m) / (self.high_m - self.low_m)
        width = self.low_radius_m + slope * (origin[:, 2] - self.low_m)
        wider = slope * way[:, 2]
        a = way[:, 0] ** 2 + way[:, 1] ** 2 - wider**2
        b = origin[:, 0] * way[:, 0] + origin[:, 1] * way[:, 1] - width * wider
        c = origin[:, 0] ** 2 + origin[:, 1] ** 2 - width**2
        inside = b * b - a * c
        root = np.sqrt(np.maximum(inside, 0.0))
        best = np.full(len(way), np.inf)
        for sign in (-1.0, 1.0):
            far = (-b + sign * root) / a
            z = origin[:, 2] + far * way[:, 2]
            good = (inside > 0.0) & (far > _NEAR_M) & (z >= self.low_m) & (z <= self.high_m)
            best = np.where(good & (far < best), far, best)
        place = origin + np.where(np.isfinite(best), best, 0.0)[:, None] * way
        across = np.hypot(place[:, 0], place[:, 1]) + 1e-12
        normal = np.column_stack([place[:, :2] / across[:, None], np.full(len(way), -slope)])
        return best, normal / math.hypot(1.0, slope)


Part = Annulus | Rectangle | Cone


@dataclass(frozen=True)
class Light:
    """Sun and detector."""

    sun: tuple[float, float, float] = (0.5, 0.3, 0.8)  # towards it, in the vehicle's frame
    even: float = 0.12  # share of the light from everywhere
    peak: float = 200.0  # grey, of a white surface that faces the Sun
    black: float = 6.0
    noise: float = 2.0  # grey, one σ of one pixel


def _meet(parts: list[Part], origin: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance, number of the part (-1: none) and normal of each ray."""
    best = np.full(len(way), np.inf)
    part = np.full(len(way), -1)
    normal = np.zeros(way.shape)
    for k, one in enumerate(parts):
        far, across = one.meet(origin, way)
        near = far < best
        best[near], part[near], normal[near] = far[near], k, across[near]
    return best, part, normal


def _shade(
    parts: list[Part], eye: np.ndarray, way: np.ndarray, light: Light
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance 0 … 1 and a label of part and shadow of rays (N, 3) from one point."""
    far, part, normal = _meet(parts, np.broadcast_to(eye, way.shape), way)
    hit = part >= 0
    grey, label = np.zeros(len(way)), np.full(len(way), -1)
    if not hit.any():
        return grey, label
    normal, seen = normal[hit], way[hit]
    normal = np.where(np.sum(normal * seen, axis=1)[:, None] > 0.0, -normal, normal)
    sun = np.asarray(light.sun) / np.linalg.norm(light.sun)
    place = eye + far[hit, None] * seen + 2.0 * _NEAR_M * normal
    lit = normal @ sun > 0.0
    shadow, *_ = _meet(parts, place[lit], np.broadcast_to(sun, (int(lit.sum()), 3)))
    lit[lit] = ~np.isfinite(shadow)
    white = np.array([one.grey for one in parts])[part[hit]]
    grey[hit] = white * (light.even + (1.0 - light.even) * np.where(lit, normal @ sun, 0.0))
    label[hit] = 2 * part[hit] + lit
    return grey, label


def facing(
    camera: Pinhole, range_m: float, tilt: float, way: float, roll: float, place_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,), camera from vehicle, its axis (+z) at the camera.

    The axis leans ``tilt`` from the line of sight, towards ``way``; its foot is at ``place_px``.
    """
    x, y = (place_px[0] - camera.cx) / camera.focal_px, (place_px[1] - camera.cy) / camera.focal_px
    sight = np.array([x, y, 1.0])
    sight /= np.linalg.norm(sight)
    across = np.cross([0.0, 0.0, 1.0], sight)
    off = float(np.linalg.norm(across))
    aim = turn(across, math.asin(min(off, 1.0))) if off > 1e-9 else np.eye(3)
    lean = turn(np.array([math.cos(way), math.sin(way), 0.0]), tilt)
    rotation = aim @ lean @ turn(np.array([0.0, 0.0, 1.0]), roll) @ np.diag([1.0, -1.0, -1.0])
    return rotation, range_m * sight


def picture(
    camera: Pinhole, rotation: np.ndarray, translation: np.ndarray, parts: list[Part], light: Light,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """(H, W) uint8 of a vehicle before a black sky."""
    eye = -rotation.T @ translation

    def ways(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        rays = np.column_stack(
            [(x - camera.cx) / camera.focal_px, (y - camera.cy) / camera.focal_px, np.ones(len(x))]
        )
        return (rays / np.linalg.norm(rays, axis=1)[:, None]) @ rotation

    v, u = np.mgrid[: camera.height, : camera.width]
    grey, label = np.zeros(u.shape), np.full(u.shape, -1)
    # Every fourth ray finds where the vehicle is; none of its parts is smaller before the sky.
    rough = _shade(parts, eye, ways(u[::4, ::4].ravel(), v[::4, ::4].ravel()), light)[1] >= 0
    wide = np.pad(rough.reshape(u[::4, ::4].shape), 1)
    wide = np.any([np.roll(wide, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    near = wide[1:-1, 1:-1].repeat(4, axis=0).repeat(4, axis=1)[: camera.height, : camera.width]
    grey[near], label[near] = _shade(parts, eye, ways(u[near], v[near]), light)
    border = np.zeros(u.shape, dtype=bool)
    for axis in (0, 1):
        change = np.diff(label, axis=axis) != 0
        ahead = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        after = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        border[ahead] |= change
        border[after] |= change
    if border.any():
        steps = (np.arange(FINE) + 0.5) / FINE - 0.5
        dy, dx = (one.ravel() for one in np.meshgrid(steps, steps, indexing="ij"))
        x = (u[border][:, None] + dx).ravel()
        y = (v[border][:, None] + dy).ravel()
        grey[border] = _shade(parts, eye, ways(x, y), light)[0].reshape(-1, FINE**2).mean(axis=1)
    soft = np.pad(grey, 1, mode="edge")  # the optics: about σ 0.6 px
    taps = (0.16, 0.68, 0.16)
    soft = sum(t * soft[k : k + grey.shape[0]] for k, t in enumerate(taps))
    soft = sum(t * soft[:, k : k + grey.shape[1]] for k, t in enumerate(taps))
    noisy = light.black + light.peak * soft + light.noise * rng.standard_normal(grey.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


# A bus with an adapter cone, a ring with an inner edge, and a nozzle. Circles as a target file has
# them: height over the ring's plane and radius, m.
RADIUS_M = 0.6
CIRCLES = ((-0.25, 0.71), (-0.25, 0.645), (0.0, 0.56), (0.07, 0.14))


def vehicle(one_grey: float | None = None) -> list[Part]:
    """The parts; all of one reflectance if ``one_grey`` is given. The ring's plane is at 0."""

    def g(own: float) -> float:
        return own if one_grey is None else one_grey

    return [
        Rectangle(-0.28, (1.1, 1.2), g(0.45)),
        Rectangle(-0.27, (0.14, 0.2), g(0.9), (0.75, 0.7)),
        Annulus(-0.1, 0.0, 0.25, g(0.7), (-0.8, 0.75)),  # a dish
        Annulus(-0.25, 0.0, 0.71, g(0.8)),  # the foot's plate
        Cone(-0.25, 0.645, -0.02, 0.6, g(0.35)),
        Cone(-0.02, 0.6, 0.0, 0.6, g(0.35)),
        Annulus(0.0, 0.56, 0.6, g(0.95)),  # the ring
        Cone(-0.24, 0.56, 0.0, 0.56, g(0.25)),  # its inside
        Annulus(-0.24, 0.0, 0.56, g(0.15)),
        Cone(-0.2, 0.05, 0.07, 0.14, g(0.6)),
        Annulus(-0.2, 0.0, 0.1, g(0.3)),
    ]


# A station: a wide end with a launch ring that stands out, bolts' circles and a hatch.
STATION_RADIUS_M = 0.8
STATION_CIRCLES = ((-0.35, 2.0), (-0.12, 0.98), (0.0, 0.74), (-0.05, 0.5))


def station(one_grey: float | None = None) -> list[Part]:
    """The parts of a station's end."""

    def g(own: float) -> float:
        return own if one_grey is None else one_grey

    return [
        Rectangle(-2.5, (6.0, 0.8), g(0.3)),
        Cone(-3.5, 2.0, -0.35, 2.0, g(0.6)),
        Annulus(-0.35, 0.98, 2.0, g(0.7)),
        Annulus(-0.2, 0.0, 0.3, g(0.4), (1.4, 0.5)),
        Annulus(-0.2, 0.0, 0.25, g(0.9), (-1.3, 0.8)),
        Cone(-0.35, 0.98, -0.12, 0.98, g(0.5)),
        Annulus(-0.12, 0.8, 0.98, g(0.55)),
        Cone(-0.12, 0.8, 0.0, 0.8, g(0.4)),
        Annulus(0.0, 0.74, 0.8, g(0.85)),
        Cone(-0.05, 0.74, 0.0, 0.74, g(0.5)),
        Annulus(-0.05, 0.5, 0.74, g(0.35)),
        Annulus(-0.06, 0.0, 0.5, g(0.75)),
    ]
