"""Pictures of a panel with a ring before it, from the distance of pixels to their outlines."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose

PANEL_M, RADIUS_M, WIDTH_M, DISTANCE_M = (8.0, 2.4), 0.597, 0.12, 1.68
BLUR_PX = 0.8


def camera_at(angle_rad: float, range_m: float = 12.0, lift: float = 0.1) -> Pose:
    """Camera from panel, the boresight at the panel's middle."""
    out = np.array([np.cos(angle_rad), np.sin(angle_rad), lift])
    out /= np.linalg.norm(out)
    right = np.cross([0.0, 0.0, -1.0], -out)
    right /= np.linalg.norm(right)
    rotation = np.vstack([right, np.cross(-out, right), -out])
    return Pose(rotation, rotation @ (-range_m * out))


def draw(
    camera: Camera,
    pose: Pose,
    rng: np.random.Generator,
    offset_m: tuple[float, float] = (0.0, 0.0),
    noise_grey: float = 2.0,
    panel_grey: float = 110.0,
    ring_grey: float = 220.0,
) -> np.ndarray:
    """(H, W) uint8: a grey panel, before it a bright ring with a dark middle; noise."""
    picture = np.full((camera.height, camera.width), 12.0)
    across, up = _on_plane(camera, pose, 0.0)
    inside = _within(0.5 * PANEL_M[0] - np.abs(across)) * _within(0.5 * PANEL_M[1] - np.abs(up))
    picture += inside * (panel_grey - picture)
    across, up = _on_plane(camera, pose, DISTANCE_M)
    away = np.hypot(across - offset_m[0], up - offset_m[1])
    for radius, level in ((RADIUS_M, ring_grey), (RADIUS_M - WIDTH_M, 60.0)):
        picture += _within(radius - away) * (level - picture)
    noisy = picture + rng.normal(0.0, noise_grey, picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def plane_range(pose: Pose) -> float:
    """Along the boresight to the panel."""
    axis = pose.rotation[:, 0]
    return float(axis @ pose.translation_m / axis[2])


def _on_plane(camera: Camera, pose: Pose, distance_m: float) -> tuple[Array, Array]:
    """Panel coordinates y, z (H, W) where the pixels' rays meet the plane x = ``distance_m``."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    turn, place = pose.rotation, pose.rotation.T @ pose.translation_m
    rays = [(turn[0, k] * x + turn[2, k])[None, :] + (turn[1, k] * y)[:, None] for k in range(3)]
    far = (distance_m + place[0]) / rays[0]
    return far * rays[1] - place[1], far * rays[2] - place[2]


def _within(depth: Array) -> Array:
    """Share (H, W) of a pixel inside an outline that lies where ``depth`` is 0, with its blur."""
    down, right = np.gradient(depth)
    return np.asarray(ndtr(depth / np.maximum(np.hypot(down, right), 1e-12) / BLUR_PX))
