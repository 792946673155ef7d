"""Options of training, and the geometry of the training views."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import MAX_ORDER
from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.renderers import Renderer

# Options whose name in files is older than the one in code.
_FILE_NAMES = {"shadowed_silhouettes": "lit_views", "forest_trees": "voters"}
OLD_NAMES = {old: new for new, old in _FILE_NAMES.items()}  # accepted in files


class Neighbourhood(StrEnum):
    """Interpretation of the paper's 19 in-views and 54 out-views of a node (its figure 3)."""

    DISC = "disc"  # out-views: the 54 nearest after the in-views, a disc of 2.18 edges
    RINGS = "rings"  # out-views: the lattice's rings at 2 and 2.5 edges, 24 + 30 views
    ALL = "all"  # out-views: every other lattice point within 3 edges


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of training one view model. The defaults are robust; ``paper`` gives the paper's."""

    order: int = 3  # of the geodesic sphere; 3 has 642 nodes. Source: the paper's choice
    bins: int = 360  # readings of a signature
    smooth_bins: int = 9  # bins; averages outline noise and structure thinner than 2 % of a turn
    component_step: int = 4  # bins; smoothed neighbours are alike, so trees use every fourth
    resolution_px: int = 512  # px; width of the lattice's views, which the bounding sphere fills
    sphere_radius_m: float | None = None  # None: set by the camera's field of view
    renderer: Renderer = Renderer.NUMBA
    neighbourhood: Neighbourhood = Neighbourhood.DISC  # of the paper's training
    perturbed_views: int = 32_000  # random views as a real camera sees them; 0: the paper's 73
    clean_fraction: float = 0.25  # of the perturbed views: without noise, at the sphere radius
    held_out_views: int = 4_000  # perturbed views for the reported accuracy, never trained on
    range_radii: tuple[float, float] = (1.0, 3.0)  # sphere radii; ranges of the perturbed views
    roll_error_rad: float = float(np.deg2rad(1.0))  # rad, one σ, in training on perturbed views
    noise_sigma_grey: float = 3.0  # grey levels, one σ; the target has 80 to 200
    label_edges: float = 1.15  # edges; in-views are closer. Between the lattice's 1 and 1.32
    reach_edges: float = 3.3  # edges; every closer perturbed view is a sample of the node
    far_edges: float = 6.0  # edges; up to this distance, only far_fraction of the views are samples
    far_fraction: float = 0.2  # of the views beyond reach_edges; they keep distant nodes inactive
    contour_points: int = 158  # per view, for refinement; 0: no refinement
    contour_radii: tuple[float, ...] = (1.0, 1.5, 3.0)  # sphere radii; distances of the shells
    # px; width of the views that decide which edges are visible. Source: pose-accuracy, the
    # errors are those of 800, where contours take half as long again
    contour_resolution_px: int = 560
    # rad; near views are within this angle of the docking ring's axis, as seen from its centre; 0:
    # none. Source: corridors of approach are 10° to 15° to either side
    near_cone_rad: float = float(np.deg2rad(20.0))
    shadowed_silhouettes: bool = (
        True  # sunlit parts per Sun direction, for first poses in hard light
    )
    sketches: bool = True  # of the nodes' views, for frames in which no threshold finds the target
    forest_trees: int = (
        5  # small trees of each node for first poses, with shadowed_silhouettes; 0: none
    )
    surface_points: int = 4096  # with visibility per direction, for shading checks; 0: none
    min_samples_split: int = 4  # samples; the paper's rule "too few samples"
    min_gain: float = 1e-3  # nats per sample of the tree; the paper's least entropy gain
    seed: int = 0

    def __post_init__(self) -> None:
        checks = {
            "order": 0 <= self.order < MAX_ORDER,
            "bins": 8 <= self.bins <= 4096,
            "smooth_bins": self.smooth_bins % 2 == 1 and 1 <= self.smooth_bins <= self.bins // 2,
            "component_step": 1 <= self.component_step <= self.bins // 4,
            "resolution_px": 32 <= self.resolution_px <= 8192,
            "sphere_radius_m": self.sphere_radius_m is None or 0 < self.sphere_radius_m < np.inf,
            "perturbed_views": 0 <= self.perturbed_views <= 10_000_000,
            "held_out_views": 0 <= self.held_out_views <= 10_000_000,
            "clean_fraction": 0.0 <= self.clean_fraction <= 1.0,
            "range_radii": 1.0 <= self.range_radii[0] <= self.range_radii[1] < np.inf,
            "roll_error_rad": 0.0 <= self.roll_error_rad <= np.pi,
            "noise_sigma_grey": 0.0 <= self.noise_sigma_grey <= 255.0,
            "label_edges": 0.5 <= self.label_edges <= 2.0,
            "reach_edges": self.label_edges <= self.reach_edges < np.inf,
            "far_edges": 0.0 <= self.far_edges < np.inf,
            "far_fraction": 0.0 <= self.far_fraction <= 1.0,
            "contour_points": self.contour_points == 0 or 20 <= self.contour_points <= 4096,
            "contour_radii": len(self.contour_radii) > 0
            and all(0.3 <= r < np.inf for r in self.contour_radii)
            and sorted(set(self.contour_radii)) == list(self.contour_radii),
            "near_cone_rad": 0.0 <= self.near_cone_rad <= np.pi / 3,
            "contour_resolution_px": 64 <= self.contour_resolution_px <= 8192,
            "surface_points": self.surface_points == 0 or 64 <= self.surface_points <= 65_536,
            "forest_trees": 0 <= self.forest_trees <= 64,
            "min_samples_split": self.min_samples_split >= 2,
            "min_gain": 0.0 <= self.min_gain < np.inf,
            "seed": self.seed >= 0,
        }
        for name, right in checks.items():
            if not right:
                raise RendezviewError(
                    f"training option {name} = {getattr(self, name)} is out of range"
                )

    def as_record(self) -> dict[str, Any]:
        """The options as a model's provenance stores them, under the names of the file format."""
        return {
            _FILE_NAMES.get(f.name, f.name): list(v) if isinstance(v, tuple) else v
            for f, v in ((f, getattr(self, f.name)) for f in fields(self))
        }

    def paper(self) -> TrainingOptions:
        """The paper's own training: 73 clean views per node, every raw bin a component."""
        return replace(
            self,
            perturbed_views=0,
            smooth_bins=1,
            component_step=1,
            label_edges=1.0,
            contour_points=0,
            shadowed_silhouettes=False,
            forest_trees=0,
            sketches=False,
            surface_points=0,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ViewGeometry:
    """Positions and focal lengths of the training cameras."""

    centre_m: Array  # (3,) of the target's bounding sphere, target frame
    target_radius_m: float
    sphere_radius_m: float
    resolution_px: int
    focal_px: float  # of the lattice's views: the bounding sphere fills the picture
    flight_focal_px: float  # of the perturbed views: that of the flight camera
    flight_half_px: float  # from the flight camera's boresight to the nearest border
    # rad; a drawn view is at most twice as wide, and shows the sphere's content only. None: all
    near_half_rad: float | None = None


DEFAULT_RADII = 3.0  # target radii; sphere radius without a camera
_LEAST_RADII = 1.25  # target radii; closer, perspective hides most of the target
_FILL = 0.95  # share of the picture that the target fills at the sphere radius
_LEAST_SPHERE_RADII = 1.05  # target radii; least sphere radius that an option may give
_LEAST_SHELL_RADII = 1.02  # target radii; least distance of a shell


def view_geometry(
    mesh: Mesh,
    options: TrainingOptions,
    camera: Camera | None,
    bounding_sphere: tuple[Array, float] | None = None,
) -> ViewGeometry:
    """The sphere of views: its radius as given, or such that the target fills the picture.

    ``bounding_sphere``: centre (3,) and radius (m) instead of the mesh's own, of a target whose
    parts turn.

    Raises:
        RendezviewError: the sphere does not enclose the target, or the camera does not determine
            its radius.
    """
    centre_m, target_radius_m = bounding_sphere or mesh.bounding_sphere
    if options.sphere_radius_m is not None:
        radius_m = options.sphere_radius_m
        if radius_m <= _LEAST_SPHERE_RADII * target_radius_m:
            raise RendezviewError(
                f"a sphere of {radius_m:.3g} m does not enclose the target, whose own radius is "
                f"{target_radius_m:.3g} m: give at least {_LEAST_RADII * target_radius_m:.3g} m"
            )
    elif camera is not None:
        if camera.half_fov_rad == 0.0:
            raise RendezviewError(
                "the camera's boresight lies outside its picture, so its field of view does not "
                "determine the sphere: give the sphere radius"
            )
        radii = 1.0 / np.sin(_FILL * camera.half_fov_rad)
        radius_m = float(max(radii, _LEAST_RADII)) * target_radius_m
    else:
        radius_m = DEFAULT_RADII * target_radius_m
    if (
        options.contour_points
        and options.contour_radii[0] * radius_m <= _LEAST_SHELL_RADII * target_radius_m
    ):
        raise RendezviewError(
            f"a shell of {options.contour_radii[0] * radius_m:.3g} m does not enclose the target, "
            f"whose own radius is {target_radius_m:.3g} m: the least shell is "
            f"{_LEAST_SHELL_RADII * target_radius_m / radius_m:.2f} sphere radii"
        )
    tangent = np.tan(np.arcsin(target_radius_m / radius_m))
    focal_px = (0.5 * options.resolution_px - 4.0) / tangent
    if camera is not None:
        flight_focal_px = float(np.sqrt(camera.fx * camera.fy))
        flight_half_px = flight_focal_px * float(np.tan(camera.half_fov_rad))
    else:
        flight_half_px = 240.0
        flight_focal_px = _FILL * flight_half_px / float(tangent)
    return ViewGeometry(
        centre_m,
        target_radius_m,
        radius_m,
        options.resolution_px,
        float(focal_px),
        flight_focal_px,
        flight_half_px,
    )
