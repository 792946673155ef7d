"""Training pictures of the sketch network: random craft in hard light, with their ideal maps.

A craft is drawn once, which is slow: its maps, and its radiance in sunlight and in the light of the
sky. Any number of photographs with other exposures, skies and defects are then taken of it.
Source of all numbers: by construction of the training set.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from experiments.training.random_skies import random_sky
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.zbuffer import Float32s, Int32s, draw_perspective, empty_buffers
from rendezview.sensors.appearance.edges.network import SIDE_PX
from rendezview.sensors.appearance.model.sketches import COVER, MAPS
from rendezview_ground.learn.views.sketch_maps import SAMPLES, sketch_maps
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.crossings import face_normals
from rendezview_ground.simulate.cloudy_skies import cloudy_sky
from rendezview_ground.simulate.hard_light import HardLightOptions, log_uniform, photograph
from rendezview_ground.simulate.scene import sun_at_phase
from rendezview_ground.simulate.shading import ShadingOptions, render

SKY_PX = 320  # px a side; a picture shows a part of it
DRAWINGS = 6  # of each craft
_FOCAL_SIDES = (0.8, 6.0)  # focal length over the side of the picture, log
# Of the craft in a picture of SIDE_PX, log; larger pictures have it larger: all of it, or nearly …
_RADIUS_PX = (28.0, 165.0)
_NEAR_RADIUS_PX = (110.0, 380.0)  # … or cut by the border
_NEAR_SHARE = 0.3
_LEAST_RADII = 1.6  # of the craft; the camera is no nearer
_LEAST_COVER = 4 / 255  # of the picture; emptier ones are drawn again
_EARTH_SHARE = 0.8  # of the skies are pictures of the Earth
_WHOLE_SHARE = 0.12  # of these show the whole Earth, or half of it
_NEAR_M = 0.05  # m; triangles are clipped there
_AROUND_PX = 8  # around the mesh, where its lines may reach
_REMAP_ROWS = 30_000  # that OpenCV reads at once: fewer than 2¹⁵


@dataclass(frozen=True, slots=True, eq=False)
class CraftDrawing:
    """A craft in a pose, before any camera has seen it."""

    maps: npt.NDArray[np.uint8]  # (MAPS, S, S) of ``sketch_maps``, 0 … 255
    light: npt.NDArray[np.float16]  # (2, S, S) radiance in sunlight and in the light of the sky
    # (S, S) 0 … 255, what hides the sky: the craft and bodies around it; None: the craft alone
    covered: npt.NDArray[np.uint8] | None = None


def take(
    drawing: CraftDrawing,
    sky: Float32s,
    rng: np.random.Generator,
    options: HardLightOptions | None = None,
) -> tuple[Float32s, Float32s]:
    """A photograph of a drawn craft, turned and mirrored at random, and its maps.

    A drawing larger than SIDE_PX is a closer pass: sky and all lengths in pixels grow with it.
    """
    larger = drawing.maps.shape[-1] / SIDE_PX
    if larger > 1.0:
        options = magnified(options or HardLightOptions(), larger)
        sky = np.asarray(cv2.resize(sky.astype(np.float32), None, fx=larger, fy=larger))
    turns, mirrored = int(rng.integers(4)), rng.random() < 0.5
    covered = drawing.maps[COVER] if drawing.covered is None else drawing.covered
    maps, light, covered = (
        _turned(part, turns, mirrored).astype(np.float32)
        for part in (drawing.maps, drawing.light, covered)
    )
    maps /= np.float32(255.0)
    covered /= np.float32(255.0)
    return photograph(light[0], light[1], covered, sky, rng, options), maps


def magnified(options: HardLightOptions, larger: float) -> HardLightOptions:
    """The conditions of a look that is so many times closer: at most so many times more blurred."""

    def longer(lengths_px: tuple[float, float]) -> tuple[float, float]:
        return lengths_px[0], larger * lengths_px[1]

    return replace(
        options,
        dirt_size_px=longer(options.dirt_size_px),
        blur_sigma_px=longer(options.blur_sigma_px),
        defocus_px=longer(options.defocus_px),
        bloom_sigma_px=longer(options.bloom_sigma_px),
        smooth_noise_sigma_px=larger * options.smooth_noise_sigma_px,
    )


def draw_craft(
    mesh: Mesh, rng: np.random.Generator, side_px: int = SIDE_PX, texture: Float32s | None = None
) -> CraftDrawing:
    """A craft in a random pose and random sunlight, that covers a part of a square picture.

    ``texture``: (T, T) reflectance 0 … 1 of what is stuck on its sides, other parts on each.
    """
    sphere = mesh.bounding_sphere
    while True:
        drawing = _draw_anywhere(mesh, sphere, rng, side_px, texture)
        if drawing.maps[0].mean() > 255.0 * _LEAST_COVER:
            return drawing


def draw_sky(rng: np.random.Generator) -> Float32s:
    """(SKY_PX, SKY_PX) radiance; the brightest hundredth is about 1."""
    if rng.random() < _EARTH_SHARE:
        return cloudy_sky(SKY_PX, rng, whole=rng.random() < _WHOLE_SHARE)
    sky = random_sky(SKY_PX, SKY_PX, rng)
    return np.asarray(sky / max(float(np.percentile(sky, 99.0)), 0.05), dtype=np.float32)


def _draw_anywhere(
    mesh: Mesh,
    sphere: tuple[Array, float],
    rng: np.random.Generator,
    side_px: int,
    texture: Float32s | None,
) -> CraftDrawing:
    camera, pose = _view(sphere, rng, side_px)
    centre_m = pose.apply(sphere[0])
    samples = _samples(mesh, camera, pose)
    maps, normals = _maps_and_normals(samples, sphere[1])
    sun = sun_at_phase(centre_m, np.deg2rad(rng.uniform(0.0, 150.0)), rng.uniform(0.0, 2.0 * np.pi))
    gloss = float(rng.choice([0.0, 0.15, 0.6, 2.0]))
    shininess = float(log_uniform((4.0, 120.0), rng))
    shading = ShadingOptions(
        samples=2, specular=gloss, shininess=shininess, ambient=0.0, earthshine=0.0,
        shadow_texels_max=1024,
    )  # fmt: skip
    sunlit = render(mesh, camera, pose, sun, shading).radiance
    ambient = _albedo(mesh, camera, pose, centre_m, normals) * _bright_side(normals, rng)
    light = np.stack([sunlit, ambient])
    if texture is not None:
        light *= _reduced(_textured(samples, camera, pose, sphere, texture, rng))
    drawn = np.rint(255.0 * np.clip(maps, 0.0, 1.0)).astype(np.uint8)
    return CraftDrawing(drawn, light.astype(np.float16))


def _view(
    sphere: tuple[Array, float], rng: np.random.Generator, side_px: int
) -> tuple[Camera, Pose]:
    """Any attitude, anywhere in the picture, sometimes across its border."""
    centre_m, radius_m = sphere
    focal = side_px * log_uniform(_FOCAL_SIDES, rng)
    middle = 0.5 * (side_px - 1)
    camera = Camera(width=side_px, height=side_px, fx=focal, fy=focal, cx=middle, cy=middle)
    sizes = _NEAR_RADIUS_PX if rng.random() < _NEAR_SHARE else _RADIUS_PX
    radius_px = side_px / SIDE_PX * log_uniform(sizes, rng)
    room = max(0.5 * side_px - radius_px * rng.uniform(0.55, 1.0), 8.0)
    shift = rng.uniform(-1.0, 1.0, 2) * room / focal
    range_m = max(focal * radius_m / radius_px, _LEAST_RADII * radius_m)
    place = range_m * np.array([*shift, 1.0])
    rotation = Rotation.random(random_state=rng).as_matrix()
    return camera, Pose(rotation, place - rotation @ centre_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """SAMPLES × SAMPLES a pixel of a mesh in a pose."""

    nearness: Float32s  # 1/z, 1/m; 0: sky
    owner: Int32s  # the face there; −1: sky
    normals: Float32s  # (F, 3) of ``face_normals``


def _samples(mesh: Mesh, camera: Camera, pose: Pose) -> _Samples:
    n = SAMPLES
    vertices = np.ascontiguousarray(pose.apply(mesh.vertices_m))
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
    nearness, owner = empty_buffers(camera.height * n, camera.width * n)
    cx, cy = n * (camera.cx + 0.5) - 0.5, n * (camera.cy + 0.5) - 0.5
    draw_perspective(
        vertices, faces, camera.fx * n, camera.fy * n, cx, cy, _NEAR_M, nearness, owner
    )
    return _Samples(nearness, owner, face_normals(vertices, faces).astype(np.float32))


def _maps_and_normals(samples: _Samples, radius_m: float) -> tuple[Float32s, Float32s]:
    """(MAPS, S, S) of an ideal sketch, and (S, S, 3) mean normals; only the mesh is searched."""
    side = len(samples.owner) // SAMPLES
    maps, normals = np.zeros((MAPS, side, side), np.float32), np.zeros((side, side, 3), np.float32)
    shown = samples.owner >= 0
    if not shown.any():
        return maps, normals
    pixels, fine = [], []
    for axis in (1, 0):
        places = np.flatnonzero(shown.any(axis)) // SAMPLES
        first, last = max(places[0] - _AROUND_PX, 0), min(places[-1] + _AROUND_PX + 1, side)
        pixels.append(slice(first, last))
        fine.append(slice(SAMPLES * first, SAMPLES * last))
    owner = samples.owner[tuple(fine)]
    nearness = samples.nearness[tuple(fine)]
    maps[:, *pixels] = sketch_maps(nearness, owner, samples.normals, radius_m)
    facing = samples.normals[owner]
    facing[owner < 0] = 0.0
    normals[tuple(pixels)] = _reduced(facing)
    return maps, normals


def _reduced(samples: Float32s) -> Float32s:
    """Means of the samples of each pixel."""
    size = samples.shape[1] // SAMPLES, samples.shape[0] // SAMPLES
    return np.asarray(cv2.resize(samples, size, interpolation=cv2.INTER_AREA))


def _textured(
    samples: _Samples,
    camera: Camera,
    pose: Pose,
    sphere: tuple[Array, float],
    texture: Float32s,
    rng: np.random.Generator,
) -> Float32s:
    """Reflectance of each sample: the texture, seen along the axis next to the face's normal."""
    v, u = np.nonzero(samples.owner >= 0)
    z = 1.0 / samples.nearness[v, u]
    x = z * ((u + 0.5) / SAMPLES - 0.5 - camera.cx) / camera.fx
    y = z * ((v + 0.5) / SAMPLES - 0.5 - camera.cy) / camera.fy
    points = (np.stack([x, y, z], 1) - pose.translation_m) @ pose.rotation - sphere[0]
    axes = np.abs(samples.normals @ pose.rotation).argmax(1)[samples.owner[v, u]]
    scale = len(texture) / (2.0 * sphere[1]) * rng.uniform(0.5, 2.0)
    factor = np.ones(samples.owner.shape, np.float32)
    for axis in range(3):
        if rng.random() < 0.15:  # bare sides
            continue
        here = axes == axis
        across = scale * np.delete(points[here], axis, 1) + rng.uniform(0.0, len(texture), 2)
        across = across.astype(np.float32)[:, None]  # a picture one pixel wide
        for first in range(0, len(across), _REMAP_ROWS):
            part = slice(first, first + _REMAP_ROWS)
            read = cv2.remap(texture, across[part, :, 0], across[part, :, 1], cv2.INTER_LINEAR,
                             borderMode=cv2.BORDER_REFLECT)  # fmt: skip
            factor[v[here][part], u[here][part]] = np.asarray(read)[:, 0]
    return factor


def _albedo(mesh: Mesh, camera: Camera, pose: Pose, centre_m: Array, normals: Float32s) -> Float32s:
    """(S, S) from a rendering with a lamp at the camera and equal light from all around."""
    lamp = -centre_m / np.linalg.norm(centre_m)
    flat = ShadingOptions(samples=2, specular=0.0, ambient=1.0, earthshine=0.0, shadows=False)
    radiance = render(mesh, camera, pose, lamp, flat).radiance
    return np.asarray(radiance / (1.0 + np.maximum(normals @ lamp, 0.0)), dtype=np.float32)


def _bright_side(normals: Float32s, rng: np.random.Generator) -> Float32s:
    """(S, S) irradiance of a sky that is brighter on one side."""
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    towards = np.maximum(0.5 + 0.5 * (normals @ direction), 0.0)
    return np.asarray(0.25 + 0.75 * towards ** rng.uniform(0.7, 3.0), dtype=np.float32)


def _turned(planes: np.ndarray, turns: int, mirrored: bool) -> np.ndarray:
    """(…, S, S) by quarter turns, then left for right."""
    turned = np.rot90(planes, turns, axes=(-2, -1))
    return np.ascontiguousarray(turned[..., ::-1] if mirrored else turned)
