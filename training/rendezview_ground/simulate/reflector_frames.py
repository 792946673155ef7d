"""Frames of a video guidance sensor: laser-lit retro-reflectors, clutter and background.

A reading has a *lit* picture at 830 nm, which the reflectors' filters pass, and a *dark* one at
780 nm, which they block. Every reflector is integrated over its disc through the full camera model,
so its spot contains perspective, tilt and lens distortion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview_ground.limits import POSITIVE, check
from rendezview_ground.mesh.directions import perpendicular
from rendezview_ground.simulate.sensor import SensorOptions, expose

Grey = npt.NDArray[np.uint8]
Float32s = npt.NDArray[np.float32]

_REACH = 5.0  # σ of the blur; extent of a spot beyond its disc
# Farthest range of the automatic integration time; beyond, the return falls with range⁴
_CONTROL_RANGE_M = 40.0
_BEAM_HALF_POWER_RAD = math.radians(20.0)  # of the laser diodes, off the boresight
_RETURN_HALF_POWER_RAD = math.radians(45.0)  # of the reflectors, off their normal


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectorFrameOptions:
    """Light, optics and detector of the sensor. Grey levels are those of the 8-bit picture."""

    peak_grey: float = 180.0  # of the reflectors, by automatic integration time
    leak: float = 0.02  # share of a reflector's return that passes its filter at 780 nm
    blur_sigma_px: float = 0.7  # Gaussian optics
    noise_sigma_grey: float = 2.0  # read noise
    black_level_grey: float = 10.0
    even_light: bool = False  # of a room, on white discs; else the lasers' on retro-reflectors

    def __post_init__(self) -> None:
        check(self, POSITIVE, math.inf, "peak_grey", "blur_sigma_px")
        check(self, 0.0, math.inf, "noise_sigma_grey", "leak", "black_level_grey")


@dataclass(frozen=True, slots=True, eq=False)
class Clutter:
    """Light sources other than reflectors, one per row: glints, foil, false spots.

    Columns: x, y (px), σ along and across (px), angle (rad), peak in the lit picture, peak in the
    dark one (grey), shift of the dark one in x and y (px).
    """

    spots: Array = field(default_factory=lambda: np.empty((0, 9)))
    background: Float32s | None = None  # grey levels of both pictures


def foil(camera: Camera, rng: np.random.Generator, facets: int) -> Clutter:
    """A crumpled sheet of sunlit foil: facets around one place in both pictures, some saturated.

    Between the pictures the foil moves by 0.15 px (σ), and each facet flickers by 4 %.
    """
    centre = rng.uniform((0.0, 0.0), (camera.width, camera.height))
    spots = np.empty((facets, 9))
    spots[:, :2] = centre + rng.normal(0.0, 0.12 * camera.width, (facets, 2))
    spots[:, 2] = np.exp(rng.uniform(math.log(0.7), math.log(8.0), facets))
    spots[:, 3] = spots[:, 2] * rng.uniform(0.15, 1.0, facets)
    spots[:, 4] = rng.uniform(0.0, math.pi, facets)
    spots[:, 5] = np.exp(rng.uniform(math.log(15.0), math.log(600.0), facets))
    spots[:, 6] = spots[:, 5] * (1.0 + rng.normal(0.0, 0.04, facets))
    spots[:, 7:] = rng.normal(0.0, 0.15, 2)
    return Clutter(spots)


def glints(camera: Camera, rng: np.random.Generator, count: int) -> Clutter:
    """False spots that are missing in the dark picture, as large and bright as reflectors."""
    spots = np.zeros((count, 9))
    spots[:, :2] = rng.uniform((0.0, 0.0), (camera.width, camera.height), (count, 2))
    spots[:, 2] = np.exp(rng.uniform(math.log(0.7), math.log(6.0), count))
    spots[:, 3] = spots[:, 2] * rng.uniform(0.5, 1.0, count)
    spots[:, 4] = rng.uniform(0.0, math.pi, count)
    spots[:, 5] = rng.uniform(40.0, 400.0, count)
    return Clutter(spots)


def render_pair(
    camera: Camera,
    pattern: ReflectorPattern,
    camera_from_target: Pose,
    options: ReflectorFrameOptions,
    rng: np.random.Generator,
    *,
    hidden: tuple[int, ...] = (),
    clutter: tuple[Clutter, ...] = (),
    gain: float | None = None,
) -> tuple[Grey, Grey]:
    """The lit and the dark picture (H, W) of one reading.

    Args:
        camera: with its distortion.
        pattern: all reflectors of the target.
        camera_from_target: at both pictures, which are simultaneous (beam splitter).
        options: light, optics, detector.
        rng: of the noise.
        hidden: numbers of occluded reflectors.
        clutter: all other light.
        gain: of `exposure`, which it is where left out.
    """
    if gain is None:
        gain = exposure(camera, pattern, camera_from_target, options)
    pictures = []
    for number in range(2):
        grey = np.full((camera.height, camera.width), options.black_level_grey, np.float32)
        for item in clutter:
            if item.background is not None:
                grey += item.background
            _paint_clutter(grey, item.spots, number)
        _paint_all(grey, camera, pattern, camera_from_target, options, gain, hidden, number == 1)
        sensor = SensorOptions(
            blur_sigma_px=0.0, noise_sigma_grey=options.noise_sigma_grey, black_level_grey=0.0
        )  # the spots are blurred, and the black level is there
        pictures.append(expose(grey, 1.0, sensor, rng))
    return pictures[0], pictures[1]


def reflector_light(
    camera: Camera, pattern: ReflectorPattern, pose: Pose, options: ReflectorFrameOptions,
    gain: float, hidden: tuple[int, ...] = (), *, dark: bool = False,
) -> Float32s:  # fmt: skip
    """(H, W) grey levels of all reflectors, blurred by the optics; ``gain`` as of `exposure`."""
    grey = np.zeros((camera.height, camera.width), np.float32)
    _paint_all(grey, camera, pattern, pose, options, gain, hidden, dark)
    return grey


def _paint_all(
    grey: Float32s, camera: Camera, pattern: ReflectorPattern, pose: Pose,
    options: ReflectorFrameOptions, gain: float, hidden: tuple[int, ...], dark: bool,
) -> None:  # fmt: skip
    share = options.leak if dark else 1.0
    for k in range(len(pattern)):
        if k not in hidden:
            paint_reflector(grey, camera, pattern, k, pose, gain * share, options)


def exposure(
    camera: Camera, pattern: ReflectorPattern, pose: Pose, options: ReflectorFrameOptions
) -> float:
    """Gain that gives the brightest reflector its peak, up to the limit of the integration time.

    The gain is in grey levels per unit of `_radiance`.
    """
    gains = []
    limits = []
    for k in range(len(pattern)):
        radiance = _radiance(pattern, k, pose, options)
        if radiance <= 0.0:
            continue
        far = float(np.linalg.norm(pose.apply(pattern.positions_m[k])))
        gains.append(
            options.peak_grey / (radiance * _concentration(camera, pattern, k, far, options))
        )
        share = _concentration(camera, pattern, k, _CONTROL_RANGE_M, options)
        limits.append(options.peak_grey * _CONTROL_RANGE_M**2 / share)
    return min(min(gains), min(limits)) if gains else 0.0


def _concentration(
    camera: Camera, pattern: ReflectorPattern, k: int, far_m: float, options: ReflectorFrameOptions
) -> float:
    """Peak of a disc's spot relative to a wide disc: blur spreads the light of a small one."""
    radius = 0.5 * pattern.diameters_m[k] * camera.fx / far_m
    spread = options.blur_sigma_px**2 + 1.0 / 12.0
    return 1.0 - math.exp(-0.5 * radius * radius / spread)


def _radiance(
    pattern: ReflectorPattern, k: int, pose: Pose, options: ReflectorFrameOptions
) -> float:
    """Radiance of a reflector, 1 at 1 m head-on: illumination by range² and beam, return by angle.

    In even light it is 1 everywhere.

    The returned light spreads by range² again, which the disc's solid angle contains.
    """
    place = pose.apply(pattern.positions_m[k])
    far = float(np.linalg.norm(place))
    normal = pose.rotation @ pattern.normals[k]
    incidence = -float(normal @ place) / far
    if place[2] <= 0.0 or incidence <= 0.0:
        return 0.0
    if options.even_light:
        return 1.0
    off_beam = math.acos(min(place[2] / far, 1.0)) / _BEAM_HALF_POWER_RAD
    off_normal = math.acos(min(incidence, 1.0)) / _RETURN_HALF_POWER_RAD
    return float(0.5 ** (off_beam**2) * 0.5 ** (off_normal**2) / far**2)


def paint_reflector(
    grey: Float32s,
    camera: Camera,
    pattern: ReflectorPattern,
    k: int,
    pose: Pose,
    gain: float,
    options: ReflectorFrameOptions,
) -> None:
    """Add one reflector's spot: points of its disc, each blurred by optics and pixel."""
    radiance = _radiance(pattern, k, pose, options)
    if radiance <= 0.0 or gain <= 0.0:
        return
    place = pose.apply(pattern.positions_m[k])
    radius_px = 0.5 * pattern.diameters_m[k] * max(camera.fx, camera.fy) / place[2]
    sigma = math.sqrt(options.blur_sigma_px**2 + 1.0 / 12.0)  # a pixel's own width
    points, weights = _disc(pattern, k, max(4, math.ceil(2.0 * radius_px / sigma)))
    rays = pose.apply(points)
    pixels = np.asarray(camera.project(rays))
    if not np.isfinite(pixels).all():
        return
    reach = _REACH * sigma
    x0, y0 = np.floor(pixels.min(axis=0) - reach).astype(int)
    x1, y1 = np.ceil(pixels.max(axis=0) + reach).astype(int)
    x0, y0 = max(int(x0), 0), max(int(y0), 0)
    x1, y1 = min(int(x1), camera.width - 1), min(int(y1), camera.height - 1)
    if x1 < x0 or y1 < y0:
        return
    across = np.exp(-0.5 * ((np.arange(x0, x1 + 1)[None] - pixels[:, :1]) / sigma) ** 2)
    down = np.exp(-0.5 * ((np.arange(y0, y1 + 1)[None] - pixels[:, 1:]) / sigma) ** 2)
    # Each point is weighted by its area in the picture (n·p / z³ for a plane) and its
    # illumination.
    plane = -float(pose.rotation @ pattern.normals[k] @ place)
    seen = camera.fx * camera.fy * plane / rays[:, 2] ** 3
    if not options.even_light:
        seen *= float(place @ place) / np.sum(rays * rays, axis=1)
    weights = weights * seen * math.pi * (0.5 * pattern.diameters_m[k]) ** 2
    light = gain * radiance / (2.0 * math.pi * sigma**2)
    grey[y0 : y1 + 1, x0 : x1 + 1] += (light * (down * weights[:, None]).T @ across).astype(
        np.float32
    )


def _disc(pattern: ReflectorPattern, k: int, rings: int) -> tuple[Array, Array]:
    """Points (M, 3) on a reflector, target frame, and their shares of its area (M,)."""
    normal = pattern.normals[k]
    first = perpendicular(normal)
    second = np.cross(normal, first)
    nodes, shares = np.polynomial.legendre.leggauss(rings)
    radii = np.sqrt(0.5 * (nodes + 1.0))  # Gauss nodes in radius², which is uniform in area
    spokes = max(12, 4 * rings)
    angles = 2.0 * math.pi * np.arange(spokes) / spokes
    ring = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    points = 0.5 * pattern.diameters_m[k] * radii[:, None, None] * ring
    weights = np.repeat(0.5 * shares / spokes, spokes)
    return pattern.positions_m[k] + points.reshape(-1, 3), weights


def _paint_clutter(grey: Float32s, spots: Array, number: int) -> None:
    height, width = grey.shape
    for x, y, along, across, angle, lit, dark, shift_x, shift_y in spots:
        peak = dark if number else lit
        if peak < 0.5:
            continue
        if number:
            x, y = x + shift_x, y + shift_y
        reach = 3.5 * along
        x0, x1 = max(int(x - reach), 0), min(int(x + reach) + 1, width - 1)
        y0, y1 = max(int(y - reach), 0), min(int(y + reach) + 1, height - 1)
        if x1 < x0 or y1 < y0:
            continue
        dx = np.arange(x0, x1 + 1)[None, :] - x
        dy = np.arange(y0, y1 + 1)[:, None] - y
        c, s = math.cos(angle), math.sin(angle)
        u, v = (c * dx + s * dy) / along, (c * dy - s * dx) / across
        grey[y0 : y1 + 1, x0 : x1 + 1] += (peak * np.exp(-0.5 * (u * u + v * v))).astype(np.float32)
