"""Grey pictures of a mesh in sunlight, with the truth of every pixel.

The unit of radiance is a white Lambert surface that faces the Sun. Faces are flat and two-sided.
CAD winding is unreliable, so normals are turned towards the camera. The far side of a lit sheet is
dark, because its turned normal points away from the Sun. The Sun is a direction in the *camera*
frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.zbuffer import Float32s, draw_perspective, empty_buffers
from rendezview_ground.limits import POSITIVE, check
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.crossings import face_normals
from rendezview_ground.simulate.distortion import widened
from rendezview_ground.simulate.lighting import shade_samples
from rendezview_ground.simulate.shadows import ShadowMap, shadow_map


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadingOptions:
    """Options of the shaded renderer."""

    samples: int = 3  # per pixel side: 3 means 3 × 3 samples, box-averaged
    near_m: float = 0.05  # triangles are clipped there
    specular: float = 0.15  # Blinn–Phong highlight of foil and radiators; 0: pure Lambert
    shininess: float = 30.0
    ambient: float = 0.015  # light from all directions, so that dark sides are not black
    earthshine: float = 0.15  # from below at noon, with an Earth
    shadows: bool = True
    shadow_texels_max: int = 2048  # per side of the shadow map; fewer for coarser samples

    def __post_init__(self) -> None:
        check(self, 1, 8, "samples")
        check(self, 16, 8192, "shadow_texels_max")
        check(self, POSITIVE, math.inf, "near_m")
        check(self, 0.0, math.inf, "specular", "shininess", "ambient", "earthshine")


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """The target on black, without a background."""

    radiance: Float32s  # (H, W) premultiplied by coverage: add (1 − coverage) × background
    coverage: Float32s  # (H, W) share of the pixel that the target covers
    depth_m: Float32s  # (H, W) mean z of the covered samples; infinite without any


def render(
    mesh: Mesh,
    camera: Camera,
    camera_from_target: Pose,
    sun_direction_camera: npt.ArrayLike,
    options: ShadingOptions | None = None,
    earth_direction_camera: npt.ArrayLike | None = None,
) -> Rendering:
    """Draw ``mesh`` at a pose, lit from ``sun_direction_camera`` (3,), towards the Sun.

    For a camera with distortion, a wider undistorted picture is drawn and resampled linearly. Parts
    nearer than ``near_m`` are cut away.

    Raises:
        RendezviewError: the distortion cannot be undone within a picture of
            reasonable size.
    """
    options = options or ShadingOptions()
    sun = unit(sun_direction_camera, "sun_direction_camera")
    earth = None
    if earth_direction_camera is not None:
        earth = unit(earth_direction_camera, "earth_direction_camera")
    bent = widened(camera)
    if bent is None:
        return _render_pinhole(mesh, camera, camera_from_target, sun, options, earth)
    wide = _render_pinhole(mesh, bent.pinhole, camera_from_target, sun, options, earth)
    return Rendering(
        bent.bend(wide.radiance, cv2.INTER_LINEAR),
        bent.bend(wide.coverage, cv2.INTER_LINEAR),
        bent.bend(wide.depth_m, cv2.INTER_NEAREST, outside=math.inf),
    )


def unit(direction: npt.ArrayLike, name: str) -> Array:
    """The direction (3,) with length 1.

    Raises:
        ValueError: it is not (3,), not finite or zero.
    """
    vector = np.asarray(direction, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not math.isfinite(length) or length == 0.0:
        raise ValueError(f"{name} must be three finite numbers, not all zero: {direction!r}")
    return vector / length


def _render_pinhole(
    mesh: Mesh,
    camera: Camera,
    camera_from_target: Pose,
    sun: Array,
    options: ShadingOptions,
    earth: Array | None,
) -> Rendering:
    shape = (camera.height, camera.width)
    picture = Rendering(
        np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32)
    )
    vertices = np.ascontiguousarray(camera_from_target.apply(mesh.vertices_m))
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
    left, top, right, bottom = _window(vertices, camera, options.near_m)
    if right <= left or bottom <= top:
        return picture
    # Sample i of a pixel column lies at u = (i + 0.5) / n − 0.5, so i = n (u + 0.5) − 0.5.
    n = options.samples
    nearness, owner = empty_buffers((bottom - top) * n, (right - left) * n)
    fx, fy = camera.fx * n, camera.fy * n
    cx, cy = n * (camera.cx - left + 0.5) - 0.5, n * (camera.cy - top + 0.5) - 0.5
    draw_perspective(vertices, faces, fx, fy, cx, cy, options.near_m, nearness, owner)

    normals, albedo = face_normals(vertices, faces), mesh.face_albedo
    sun_cosine = np.maximum(normals @ sun, 0.0)
    glow = np.full(len(faces), options.ambient)
    if earth is not None:  # light of a hemisphere around the Earth, in proportion to its daylight
        day = max(0.0, -float(sun @ earth))
        glow += options.earthshine * day * 0.5 * (1.0 + normals @ earth)
    shadow = ShadowMap.empty()
    if options.shadows:
        shadow = shadow_map(
            vertices, faces, sun, (nearness, owner), (fx, fy, cx, cy), sun_cosine,
            options.shadow_texels_max,
        )  # fmt: skip
    buffers = (picture.radiance, picture.coverage, picture.depth_m)
    window = np.s_[top:bottom, left:right]
    drawn = [np.ascontiguousarray(buffer[window]) for buffer in buffers]
    shade_samples(
        nearness, owner, n, fx, fy, cx, cy, normals, albedo * sun_cosine, sun_cosine,
        albedo * glow, options.specular, options.shininess, sun,
        shadow.nearness, shadow.owner, shadow.axes, shadow.origin_m, shadow.texel_m, *drawn,
    )  # fmt: skip
    for buffer, part in zip(buffers, drawn, strict=True):
        buffer[window] = part
    return picture


def _window(vertices: Array, camera: Camera, near_m: float) -> tuple[int, int, int, int]:
    """Pixel rectangle (left, top, right, bottom), ends excluded, that holds the target."""
    z = vertices[:, 2]
    if not len(z) or z.max() < near_m:
        return 0, 0, 0, 0
    if z.min() < near_m:  # part of it is behind the camera, so it may be anywhere
        return 0, 0, camera.width, camera.height
    u = camera.fx * vertices[:, 0] / z + camera.cx
    v = camera.fy * vertices[:, 1] / z + camera.cy
    low = np.floor([u.min(), v.min()]) - 1.0
    high = np.ceil([u.max(), v.max()]) + 2.0
    size = (camera.width, camera.height)
    left, top = (int(x) for x in np.clip(low, 0, size))
    right, bottom = (int(x) for x in np.clip(high, 0, size))
    return left, top, right, bottom
