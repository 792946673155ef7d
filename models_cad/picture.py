"""A small z-buffer renderer for the pictures of the target vehicles.

One sun with a shadow map, a weak bluish fill light from below, perspective camera.
World is the target frame in metres; pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from models_cad.parts import Array, Part, Vector, unit
from numpy.typing import NDArray
from PIL import Image


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The camera's place; directions and points in the target frame, metres."""

    eye: Vector
    look_at: Vector
    up: Vector = (0.0, 0.0, 1.0)
    sun: Vector = (0.3, -0.5, 0.8)  # towards the sun
    focal_px: float = 900.0  # at the final size
    size_px: tuple[int, int] = (640, 480)


OVERSAMPLING = 2  # 4 samples a pixel
SHADOW_PX = 1600
CREASE_COS = np.cos(np.radians(32.0))  # flatter edges are shaded smooth


def _corner_normals(part: Part) -> Array:
    """(F, 3, 3) normals of the corners: faces meeting flatter than the crease share theirs."""
    mesh = part.mesh
    around = mesh.vertex_faces[mesh.faces]  # (F, 3, D), −1 pads
    normals = mesh.face_normals[around] * mesh.area_faces[around][..., None]
    alike = np.einsum("fcdk,fk->fcd", mesh.face_normals[around], mesh.face_normals) > CREASE_COS
    total = np.where(((around >= 0) & alike)[..., None], normals, 0.0).sum(axis=2)
    return np.asarray(total / np.linalg.norm(total, axis=-1, keepdims=True))


def _rasterise(
    corners_px: Array, nearness: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.int64], Array]:
    """Index of the nearest triangle at each pixel (−1: none) and its nearness.

    `corners_px` (F, 3, 2), `nearness` (F, 3) is linear over the image: 1/z or −z.
    """
    ids = np.full(shape, -1)
    best = np.full(shape, -np.inf)
    low = np.maximum(np.ceil(corners_px.min(axis=1)).astype(int), 0)
    high = np.minimum(np.floor(corners_px.max(axis=1)).astype(int), [shape[1] - 1, shape[0] - 1])
    edge_1, edge_2 = corners_px[:, 1] - corners_px[:, 0], corners_px[:, 2] - corners_px[:, 0]
    area = edge_1[:, 0] * edge_2[:, 1] - edge_1[:, 1] * edge_2[:, 0]
    for face in np.flatnonzero((high >= low).all(axis=1) & (np.abs(area) > 1e-12)):
        (x0, y0), (x1, y1) = low[face], high[face]
        dx = np.arange(x0, x1 + 1)[None, :] - corners_px[face, 0, 0]
        dy = np.arange(y0, y1 + 1)[:, None] - corners_px[face, 0, 1]
        b = (dx * edge_2[face, 1] - dy * edge_2[face, 0]) / area[face]
        c = (dy * edge_1[face, 0] - dx * edge_1[face, 1]) / area[face]
        n0, n1, n2 = nearness[face]
        depth = n0 + b * (n1 - n0) + c * (n2 - n0)
        window = (slice(y0, y1 + 1), slice(x0, x1 + 1))
        closer = (b >= 0.0) & (c >= 0.0) & (b + c <= 1.0) & (depth > best[window])
        best[window][closer] = depth[closer]
        ids[window][closer] = face
    return ids, best


def _sunlit(points: Array, triangles: Array, sun: Array, right: Array) -> Array:
    """Share of the sun, 0 to 1, that reaches each of `points` (N, 3), by a shadow map."""
    basis = np.stack([right, np.cross(sun, right), sun])
    local = triangles @ basis.T
    low, high = local.min(axis=(0, 1)), local.max(axis=(0, 1))
    scale = (SHADOW_PX - 8) / float((high - low)[:2].max())
    pixels = (local[..., :2] - low[:2]) * scale + 4.0
    _, height = _rasterise(pixels, local[..., 2], (SHADOW_PX, SHADOW_PX))
    at = points @ basis.T
    sunlit = np.zeros(len(points))
    taps = [(i, j) for i in (-0.7, 0.0, 0.7) for j in (-0.7, 0.0, 0.7)]
    for i, j in taps:
        u = np.clip(np.rint((at[:, 0] - low[0]) * scale + 4.0 + i), 0, SHADOW_PX - 1).astype(int)
        v = np.clip(np.rint((at[:, 1] - low[1]) * scale + 4.0 + j), 0, SHADOW_PX - 1).astype(int)
        sunlit += at[:, 2] > height[v, u] - 2.5 / scale
    return sunlit / len(taps)


def _background(shape: tuple[int, int]) -> Array:
    """Night sky in linear light: a faint gradient and a few stars, always the same."""
    rng = np.random.default_rng(20)
    fade = np.linspace(0.0, 1.0, shape[0])[:, None, None]
    sky = np.array([0.004, 0.006, 0.013]) * (1.0 - fade) + np.array([0.010, 0.015, 0.030]) * fade
    sky = np.repeat(sky, shape[1], axis=1)
    for _ in range(90):
        y, x = rng.integers(0, shape[0] - 2), rng.integers(0, shape[1] - 2)
        sky[y : y + 2, x : x + 2] += rng.uniform(0.05, 0.5)
    return np.asarray(sky)


def render(parts: Sequence[Part], view: View) -> Image.Image:
    """Shaded picture of the parts, `view.size_px` large."""
    triangles = np.concatenate([part.mesh.triangles for part in parts])
    normals = np.concatenate([_corner_normals(part) for part in parts])
    owner = np.repeat(np.arange(len(parts)), [len(part.mesh.faces) for part in parts])
    albedo = (np.array([part.colour.srgb for part in parts]) / 255.0) ** 2.2
    metallic = np.array([part.colour.metallic for part in parts])
    gloss = 1.0 - np.array([part.colour.roughness for part in parts])

    # Camera: x right, y down, z along the boresight.
    eye = np.asarray(view.eye, float)
    forward = unit(np.asarray(view.look_at, float) - eye)
    right = unit(np.cross(forward, np.asarray(view.up, float)))
    camera = np.stack([right, np.cross(forward, right), forward])
    shape = (view.size_px[1] * OVERSAMPLING, view.size_px[0] * OVERSAMPLING)
    centre = 0.5 * (np.array([shape[1], shape[0]]) - 1.0)
    focal = view.focal_px * OVERSAMPLING
    local = (triangles - eye) @ camera.T
    ids, _ = _rasterise(
        local[..., :2] / local[..., 2:] * focal + centre, 1.0 / local[..., 2], shape
    )

    # Deferred shading: meet each pixel's ray with its triangle's plane.
    rows, columns = np.nonzero(ids >= 0)
    face = ids[rows, columns]
    slopes = (np.column_stack([columns, rows]) - centre) / focal
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ camera
    a, b, c = (triangles[face, k] for k in range(3))
    plane = np.cross(b - a, c - a)
    points = (
        eye
        + rays
        * (np.einsum("nk,nk->n", a - eye, plane) / np.einsum("nk,nk->n", rays, plane))[:, None]
    )
    square = np.einsum("nk,nk->n", plane, plane)
    weight_b = np.einsum("nk,nk->n", np.cross(points - a, c - a), plane) / square
    weight_c = np.einsum("nk,nk->n", np.cross(b - a, points - a), plane) / square
    weights = np.column_stack([1.0 - weight_b - weight_c, weight_b, weight_c])
    normal = np.einsum("nc,nck->nk", weights, normals[face])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    sun, part = unit(view.sun), owner[face]
    sunlight = np.clip(normal @ sun, 0.0, None) * _sunlit(
        points + 0.01 * normal, triangles, sun, unit(np.cross(sun, forward))
    )
    fill = 0.5 + 0.5 * normal @ unit(-sun + 0.6 * right - 0.4 * camera[1])
    ambient = 0.5 - 0.5 * normal @ forward
    light = (
        1.2 * sunlight[:, None] * np.array([1.0, 0.97, 0.92])
        + 0.10 * fill[:, None] * np.array([0.55, 0.75, 1.25])
        + 0.09 * ambient[:, None]
    )
    half = -rays / np.linalg.norm(rays, axis=1, keepdims=True) + sun
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = np.clip(np.einsum("nk,nk->n", normal, half), 0.0, 1.0) ** (4.0 + 60.0 * gloss[part])
    glint = (0.6 * gloss[part] * shine * (sunlight > 0.0) * np.minimum(sunlight * 4.0, 1.0))[
        :, None
    ] * (metallic[part][:, None] * albedo[part] + 1.0 - metallic[part][:, None])
    image = _background(shape)
    image[rows, columns] = albedo[part] * light + glint
    blocks = image.reshape(view.size_px[1], OVERSAMPLING, view.size_px[0], OVERSAMPLING, 3)
    linear = np.clip(blocks.mean(axis=(1, 3)), 0.0, 1.0)
    return Image.fromarray(np.round(255.0 * linear ** (1.0 / 2.2)).astype(np.uint8), "RGB")
