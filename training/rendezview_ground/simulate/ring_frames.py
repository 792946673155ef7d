"""Frames of a docking ring among other round objects, with the truth of every circle.

Every object is a flat plate in space. Ring edges, nozzle, dish and tank are annuli, the bus and its
panels are rectangles, obstacles are sectors of a disc. A pixel that an edge crosses is the mean of
8 × 8 rays, so the truth is exact to a hundredth of a pixel. Blur and noise follow
(`sensor.expose`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview_ground.mesh.directions import perpendicular
from rendezview_ground.simulate.distortion import pixel_rays
from rendezview_ground.simulate.sensor import SensorOptions, expose

GreyImage = npt.NDArray[np.uint8]
Float32s = npt.NDArray[np.float32]

_SAMPLES = 8  # rays per side of a pixel that an edge crosses
_ANNULUS, _RECTANGLE = 0.0, 1.0
_TAU = 2.0 * math.pi


@dataclass(frozen=True, slots=True, eq=False)
class Plate:
    """A flat object in the camera frame: an annular sector or a rectangle of one grey level."""

    centre_m: Array  # (3,)
    axis: Array  # (3,) unit, towards the camera
    across: Array  # (3,) unit, in the plane: angle 0 of a sector, the long side of a rectangle
    grey: float
    radii_m: tuple[float, float] = (0.0, 0.0)  # inner, outer, of an annulus
    sector_rad: tuple[float, float] = (0.0, _TAU)  # from, extent
    half_sides_m: tuple[float, float] | None = None  # of a rectangle
    shade: tuple[float, float] = (0.0, 0.0)  # grey levels a metre along both axes of the plane


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A true circular edge in the camera frame."""

    centre_m: Array  # (3,)
    axis: Array  # (3,) unit, towards the camera
    radius_m: float
    is_ring: bool


@dataclass(frozen=True, slots=True, eq=False)
class RingScene:
    """Plates from back to front, and the circles that are their edges."""

    camera: Camera
    plates: tuple[Plate, ...]
    circles: tuple[Circle, ...]
    sky_grey: float = 12.0

    @property
    def ring(self) -> Circle | None:
        """The ring's outer edge, which defines its radius; None without a ring."""
        rings = [circle for circle in self.circles if circle.is_ring]
        return max(rings, key=lambda circle: circle.radius_m) if rings else None


@dataclass(frozen=True, slots=True, kw_only=True)
class RingSceneOptions:
    """Distributions of a random scene; pairs are lower and upper bounds."""

    radius_m: float = 0.6
    width_px: tuple[float, float] = (150.0, 380.0)  # of the ring's outer edge
    tilt_rad: tuple[float, float] = (0.0, math.radians(60.0))
    off_axis: float = 0.6  # share of the free room in which the ring's centre lies
    edges: tuple[float, ...] = (1.0, 0.93, 0.85)  # radii of the ring's edges, the first 1
    contrast_grey: tuple[float, float] = (60.0, 140.0)
    arc_rad: tuple[float, float] = (_TAU, _TAU)  # visible arc behind an obstacle
    border: float = 0.0  # share of scenes whose ring the picture's border cuts
    clutter: int = 0  # nozzles, dishes and tanks
    without_ring: float = 0.0  # share of scenes that have clutter only
    body: bool = True


def random_scene(
    camera: Camera, rng: np.random.Generator, options: RingSceneOptions | None = None
) -> RingScene:
    """A ring on a bus face at a random place, with clutter around and inside it."""
    o = options or RingSceneOptions()
    width_px = math.exp(rng.uniform(*np.log(o.width_px)))
    depth = 2.0 * camera.fx * o.radius_m / width_px
    tilt, towards = rng.uniform(*o.tilt_rad), rng.uniform(0.0, _TAU)
    room = np.array([camera.width, camera.height]) / 2.0 - 0.5 * width_px - 8.0
    offset = o.off_axis * rng.uniform(-1.0, 1.0, 2) * np.maximum(room, 0.0)
    if rng.random() < o.border:
        side = int(rng.integers(2))
        over = rng.uniform(-0.25, 0.3) * width_px  # px inside the border
        offset[side] = (0.5 * (camera.width, camera.height)[side] - abs(over)) * rng.choice([-1, 1])
    u, v = np.add(offset, (0.5 * (camera.width - 1), 0.5 * (camera.height - 1)))
    centre = depth * np.append(camera.rays(np.array([[u, v]]))[0, :2], 1.0)
    axis = tilted_axis(centre, tilt, towards)
    across = _across(axis, rng.uniform(0.0, _TAU))
    plates: list[Plate] = []
    circles: list[Circle] = []
    body_grey = float(rng.uniform(25.0, 120.0))
    r = o.radius_m
    if o.body:
        half = (r * rng.uniform(1.25, 2.2), r * rng.uniform(1.25, 2.2))
        shade = (rng.uniform(-8, 8) / r, rng.uniform(-8, 8) / r)
        behind = centre - rng.uniform(0.1, 0.3) * r * axis
        plates.append(
            Plate(behind, axis, across, body_grey, half_sides_m=half, shade=(shade[0], shade[1]))
        )
        if rng.random() < 0.5:  # a panel beside the bus
            beside = behind + (half[0] + 1.4 * r) * across
            plates.append(Plate(beside, axis, across, float(rng.uniform(20, 90)),
                                half_sides_m=(1.3 * r, 0.5 * r)))  # fmt: skip
    for _ in range(o.clutter):
        plate = _round_object(centre, axis, r, rng)
        plates.append(plate)
        circles += [
            Circle(plate.centre_m, plate.axis, radius, False)
            for radius in plate.radii_m
            if radius > 0.0
        ]
    if rng.random() >= o.without_ring:
        grey = body_grey
        contrasts = [float(rng.uniform(*o.contrast_grey)) for _ in o.edges]
        for k, ratio in enumerate(o.edges):
            # Bright end frame, darker step, dark inside: every edge has contrast.
            step = contrasts[k] if k % 2 == 0 else -contrasts[k]
            grey = grey + step if 0.0 < grey + step < 250.0 else grey - step
            grey = float(np.clip(grey, 4.0, 250.0))
            shade = (rng.uniform(-6, 6) / r, rng.uniform(-6, 6) / r)
            plates.append(
                Plate(centre, axis, across, grey, radii_m=(0.0, ratio * r),
                      shade=(shade[0], shade[1]))
            )  # fmt: skip
            circles.append(Circle(centre, axis, ratio * r, True))
        if o.clutter and rng.random() < 0.7:  # the nozzle inside, deeper and off centre
            plate = _nozzle(centre, axis, r * min(o.edges), grey, rng)
            plates.append(plate)
            circles.append(Circle(plate.centre_m, plate.axis, plate.radii_m[1], False))
    arc = float(rng.uniform(*o.arc_rad))
    if arc < _TAU - 1e-6:
        start = rng.uniform(0.0, _TAU)
        plates.append(
            Plate(centre + 0.02 * r * axis, axis, across, float(rng.uniform(5.0, 110.0)),
                  radii_m=(0.0, 60.0 * r), sector_rad=(start, _TAU - arc))
        )  # fmt: skip
    return RingScene(camera, tuple(plates), tuple(circles), float(rng.uniform(5, 20)))


def tilted_axis(centre_m: Array, tilt_rad: float, towards_rad: float) -> Array:
    """Ring axis (3,) at an angle to the line of sight from the ring to the camera."""
    back = -centre_m / np.linalg.norm(centre_m)
    first = _across(back, towards_rad)
    return np.asarray(math.cos(tilt_rad) * back + math.sin(tilt_rad) * first)


def render_ring_frame(
    scene: RingScene, rng: np.random.Generator, sensor: SensorOptions | None = None
) -> GreyImage:
    """The 8-bit picture of a scene."""
    options = replace(sensor or SensorOptions(black_level_grey=0.0), exposure=1.0)
    return expose(radiance(scene), 1.0, options, rng)


def radiance(scene: RingScene) -> Float32s:
    """The picture before optics and detector, (H, W) grey levels."""
    camera = scene.camera
    table = np.array([_row(plate) for plate in scene.plates]).reshape(-1, 18)
    rays = np.nan_to_num(np.ascontiguousarray(pixel_rays(camera)[..., :2]), nan=1e6)
    out = np.empty((camera.height, camera.width), np.float32)
    _paint(rays, table, scene.sky_grey, out)
    return out


def _across(axis: Array, angle_rad: float) -> Array:
    first = perpendicular(axis)
    return np.asarray(
        math.cos(angle_rad) * first + math.sin(angle_rad) * np.cross(axis, first), dtype=float
    )


def _round_object(centre: Array, axis: Array, r: float, rng: np.random.Generator) -> Plate:
    """A dish beside the ring at any attitude, or the end of a tank on the bus."""
    place = centre + _across(axis, rng.uniform(0, _TAU)) * r * rng.uniform(1.1, 2.4)
    place = place - rng.uniform(-0.1, 0.2) * r * axis
    tilt = rng.uniform(0.0, 1.2)
    facing = tilted_axis(place, tilt, rng.uniform(0, _TAU)) if rng.random() < 0.5 else axis
    outer = r * rng.uniform(0.15, 0.7)
    inner = outer * rng.uniform(0.3, 0.8) if rng.random() < 0.2 else 0.0
    return Plate(place, facing, _across(facing, 0.0), float(rng.uniform(20, 230)),
                 radii_m=(inner, outer))  # fmt: skip


def _nozzle(
    centre: Array, axis: Array, inside_m: float, grey: float, rng: np.random.Generator
) -> Plate:
    radius = inside_m * rng.uniform(0.25, 0.6)
    aside = _across(axis, rng.uniform(0, _TAU)) * inside_m * rng.uniform(0.05, 0.3)
    level = grey + float(rng.choice([-1, 1])) * rng.uniform(40, 100)
    return Plate(centre + aside - 1e-3 * axis, axis, _across(axis, 0.0),
                 float(np.clip(level, 4, 250)), radii_m=(0.0, radius))  # fmt: skip


def _row(plate: Plate) -> list[float]:
    """A plate as a row of the compiled loop: homography from rays to its plane, and sizes."""
    basis = np.column_stack([plate.across, np.cross(plate.axis, plate.across), plate.centre_m])
    homography = np.linalg.inv(basis)
    kind = _ANNULUS if plate.half_sides_m is None else _RECTANGLE
    sizes = plate.radii_m if plate.half_sides_m is None else plate.half_sides_m
    return [*homography.ravel(), kind, *sizes, *plate.sector_rad, plate.grey, *plate.shade, 0.0]


@njit(cache=True, nogil=True, error_model="numpy")
def _plate_at(table: Array, x: float, y: float) -> int:
    """Number of the first plate that a ray hits, −1 for the sky."""
    for j in range(table.shape[0] - 1, -1, -1):
        t = table[j]
        w = t[6] * x + t[7] * y + t[8]
        if w <= 0.0:
            continue
        a, b = (t[0] * x + t[1] * y + t[2]) / w, (t[3] * x + t[4] * y + t[5]) / w
        if t[9] == _RECTANGLE:
            if abs(a) <= t[10] and abs(b) <= t[11]:
                return j
            continue
        square = a * a + b * b
        if square > t[11] * t[11] or square < t[10] * t[10]:
            continue
        if t[13] < _TAU and (np.arctan2(b, a) - t[12]) % _TAU > t[13]:
            continue
        return j
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def _grey(table: Array, j: int, x: float, y: float, sky: float) -> float:
    """Grey level of plate ``j`` where a ray hits it, or of the sky."""
    if j < 0:
        return sky
    t = table[j]
    w = t[6] * x + t[7] * y + t[8]
    a, b = (t[0] * x + t[1] * y + t[2]) / w, (t[3] * x + t[4] * y + t[5]) / w
    return float(max(0.0, t[14] + t[15] * a + t[16] * b))


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(rays: Array, table: Array, sky: float, out: Float32s) -> None:
    """Grey levels of all pixels; pixels whose four quarters hit different plates are averaged."""
    height, width = out.shape
    for row in range(height):
        for column in range(width):
            x, y = rays[row, column, 0], rays[row, column, 1]
            right = column + 1 if column + 1 < width else column - 1
            below = row + 1 if row + 1 < height else row - 1
            ux = (rays[row, right, 0] - x) * (right - column)
            uy = (rays[row, right, 1] - y) * (right - column)
            vx = (rays[below, column, 0] - x) * (below - row)
            vy = (rays[below, column, 1] - y) * (below - row)
            first = _plate_at(table, x, y)
            even = True
            for k in range(4):
                a, b = (k % 2) - 0.5, (k // 2) - 0.5
                if _plate_at(table, x + a * ux + b * vx, y + a * uy + b * vy) != first:
                    even = False
                    break
            if even:
                out[row, column] = _grey(table, first, x, y, sky)
                continue
            total = 0.0
            for i in range(_SAMPLES):
                a = (i + 0.5) / _SAMPLES - 0.5
                for k in range(_SAMPLES):
                    b = (k + 0.5) / _SAMPLES - 0.5
                    px, py = x + a * ux + b * vx, y + a * uy + b * vy
                    total += _grey(table, _plate_at(table, px, py), px, py, sky)
            out[row, column] = total / (_SAMPLES * _SAMPLES)
