"""Training views: clean views of the lattice, and perturbed views as a real camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.model.signature import Readings, Signature
from rendezview.sensors.appearance.model.view_model import FAR_RADII
from rendezview.sensors.appearance.outline.silhouette import outlines_of_mask
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry
from rendezview_ground.render.projection import SilhouetteRenderer, Window


@dataclass(frozen=True, slots=True, eq=False)
class ViewSet:
    """Signatures of K views and their view directions."""

    direction: Array  # (K, 3) unit, view centre → camera, target frame
    range_m: Array  # (K,) view centre to camera
    centred_from_target: Array  # (K, 3, 3)
    readings: Readings  # (K, N) smoothed
    area_sr: Array  # (K,)
    offset_m: Array  # (K, 2) view centre off the centroid's line of sight

    def __len__(self) -> int:
        return len(self.range_m)

    @classmethod
    def joined(cls, parts: list[ViewSet]) -> ViewSet:
        """Join several sets."""
        return cls(
            *(
                np.concatenate([getattr(p, name) for p in parts])
                for name in cls.__dataclass_fields__
            )
        )


def look_from(direction: Array, roll_rad: float = 0.0) -> Array:
    """(3, 3) attitude of a camera that looks at the view centre from a unit direction (3,).

    At roll 0 the target's +z is up in the picture (+x within 26° of the poles). This is a
    convention: every comparison uses the roll between two views.
    """
    up = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    z = -direction
    x = np.cross(-up, z)
    x /= np.sqrt(np.sum(x * x))
    y = np.cross(z, x)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    return np.stack([c * x - s * y, s * x + c * y, z])


def clean_views(
    renderer: SilhouetteRenderer,
    geometry: ViewGeometry,
    options: TrainingOptions,
    directions: Array,
    range_radii: float = 1.0,
) -> ViewSet:
    """Noiseless views from given directions (K, 3), in which the target fills the picture."""
    size = geometry.resolution_px
    range_m = geometry.sphere_radius_m * range_radii
    tangent = np.tan(np.arcsin(geometry.target_radius_m / range_m))
    middle = 0.5 * (size - 1)
    window = Window(size, size, (0.5 * size - 4.0) / tangent, middle, middle)
    views = []
    for direction in directions:
        rotation = look_from(direction)
        mask = renderer.draw(looking(rotation, range_m, geometry), window)
        outlines = [rays(points, window) for points in outlines_of_mask(mask)]
        views.append(view(direction, range_m, rotation, outlines, options))
    return view_set(views)


def lattice_slopes(near: ViewSet, far: ViewSet, geometry: ViewGeometry) -> Array:
    """(V,) relative change of ``area_sr × range²`` with sphere radius / range, per view."""
    near_m2, far_m2 = near.area_sr * near.range_m**2, far.area_sr * far.range_m**2
    change = 1.0 - geometry.sphere_radius_m / far.range_m
    return np.asarray((near_m2 - far_m2) / (near_m2 * change))


def far_views(
    renderer: SilhouetteRenderer,
    geometry: ViewGeometry,
    options: TrainingOptions,
    directions: Array,
) -> ViewSet:
    """Clean views from four sphere radii, where perspective is weak."""
    return clean_views(renderer, geometry, options, directions, FAR_RADII)


def looking(
    rotation: Array, range_m: float, geometry: ViewGeometry, bearing: Array | None = None
) -> Pose:
    """camera_from_target of a camera that sees the view centre at a range and a bearing."""
    sight = np.array([0.0, 0.0, range_m])
    if bearing is not None:
        sight = bearing @ sight
    return Pose(rotation, sight - rotation @ geometry.centre_m)


View = tuple[Array, float, Array, Readings, float, Array]


def rays(points_px: Array, window: Window) -> Array:
    """Undistorted rays (M, 3) of pixels of a window."""
    return plane_rays(points_px, window.focal_px, window.cx, window.cy)


def plane_rays(points_px: Array, focal_px: float, cx: float, cy: float) -> Array:
    """Rays (M, 3), z = 1, of pixels (M, 2) of an undistorted picture plane."""
    return np.column_stack([(points_px - (cx, cy)) / focal_px, np.ones(len(points_px))])


def view(
    direction: Array,
    range_m: float,
    camera_rotation: Array,
    outlines: list[Array],
    options: TrainingOptions,
) -> View:
    signature = Signature.of_outlines(outlines, options.bins, options.smooth_bins)
    if signature is None:
        raise RendezviewError(
            "the target is invisible from one side: it is flat or too thin for the "
            f"resolution of the views; its direction is {np.round(direction, 3).tolist()}"
        )
    centred = signature.centred_from_camera @ camera_rotation
    centre = -range_m * (centred @ direction)
    offset_m = centre[:2] / centre[2] * range_m
    return direction, range_m, centred, signature.readings, signature.area_sr, offset_m


def view_set(views: list[View]) -> ViewSet:
    return ViewSet(*(np.array(column) for column in zip(*views, strict=True)))
