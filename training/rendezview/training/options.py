"""What training can be told, and the values it takes by itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import MAX_ORDER
from rendezview.geometry.pose import Array
from rendezview.training.mesh import Mesh
from rendezview.training.renderers import Renderer


class Neighbourhood(StrEnum):
    """How the paper's 19 in-views and 54 out-views of a node are read (its figure 3)."""

    DISC = "disc"  # the 54 nearest after the 19: a disc of 2.18 edges
    RINGS = "rings"  # the lattice's rings at 2 and 2.5 edges: 24 + 30
    ALL = "all"  # every point of the lattice out to 3 edges


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Training of one view model. The defaults are the robust ones; see ``paper``."""

    order: int = 3  # 642 nodes, the paper's compromise
    bins: int = 360
    smooth_bins: int = 9  # noise of the outline, structure thinner than 2 % of the turn
    component_step: int = 4  # smoothed neighbours say the same: trees look at every fourth bin
    resolution_px: int = 512  # of the lattice's views, filled by the sphere's picture
    sphere_radius_m: float | None = None  # None: the camera's field of view decides
    renderer: Renderer = Renderer.NUMBA
    neighbourhood: Neighbourhood = Neighbourhood.DISC  # of the paper's training
    perturbed_views: int = 32_000  # random views as a real camera has them; 0: the paper's 73
    clean_fraction: float = 0.25  # of the perturbed views: without noise, at the sphere radius
    held_out_views: int = 4_000  # the same, never trained on: the accuracy that is reported
    range_radii: tuple[float, float] = (1.0, 3.0)  # of the perturbed views
    roll_error_rad: float = float(np.deg2rad(1.0))  # one σ, in training on perturbed views
    noise_sigma_grey: float = 3.0  # of perturbed frames whose target has 80 … 200 grey levels
    label_edges: float = 1.15  # in-views lie within: between the lattice's 1 and 1.32
    reach_edges: float = 3.3  # every perturbed view within is a sample of the node …
    far_edges: float = 6.0  # … and out to here only
    far_fraction: float = 0.2  # that share of them: it keeps far nodes off
    contour_points: int = 158  # a view, for refinement; 0: none, and no refinement
    contour_radii: tuple[float, ...] = (1.0, 1.5, 3.0)  # shells, in sphere radii
    contour_resolution_px: int = 800  # of the views that show which edges are seen
    lit_views: bool = True  # what the Sun lights from each side, for first poses in hard light
    surface_points: int = 4096  # whose light and shadow is known, for telling poses; 0: none
    min_samples_split: int = 4  # the paper's "too few samples"
    min_gain: float = 1e-3  # the paper's least entropy gain, nats per sample of the tree
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
            "contour_resolution_px": 64 <= self.contour_resolution_px <= 8192,
            "surface_points": self.surface_points == 0 or 64 <= self.surface_points <= 65_536,
            "min_samples_split": self.min_samples_split >= 2,
            "min_gain": 0.0 <= self.min_gain < np.inf,
            "seed": self.seed >= 0,
        }
        for name, right in checks.items():
            if not right:
                raise RendezviewError(
                    f"training option {name} = {getattr(self, name)} is out of range"
                )

    def paper(self) -> TrainingOptions:
        """The paper's own training: 73 clean views a node, every raw bin a component."""
        return replace(
            self,
            perturbed_views=0,
            smooth_bins=1,
            component_step=1,
            label_edges=1.0,
            contour_points=0,
            lit_views=False,
            surface_points=0,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ViewGeometry:
    """Where the cameras of the sphere stand and how they see."""

    centre_m: Array  # (3,) of the target's bounding sphere, target frame
    target_radius_m: float
    sphere_radius_m: float
    resolution_px: int
    focal_px: float  # of the lattice's views: the bounding sphere fills the picture
    flight_focal_px: float  # of the perturbed views: what the flight camera has
    flight_half_px: float  # from its boresight to the nearest border


DEFAULT_RADII = 3.0  # sphere radius over target radius where no camera says otherwise
_LEAST_RADII = 1.25  # closer, perspective hides more than it shows
_FILL = 0.95  # of the picture


def view_geometry(mesh: Mesh, options: TrainingOptions, camera: Camera | None) -> ViewGeometry:
    """The sphere of views: as told, or so that the target just fills the camera's picture.

    Raises:
        RendezviewError: the sphere does not enclose the target, or the camera does not
            decide one.
    """
    centre_m, target_radius_m = mesh.bounding_sphere
    if options.sphere_radius_m is not None:
        radius_m = options.sphere_radius_m
        if radius_m <= 1.05 * target_radius_m:
            raise RendezviewError(
                f"a sphere of {radius_m:.3g} m does not enclose the target, whose own radius is "
                f"{target_radius_m:.3g} m: give at least {_LEAST_RADII * target_radius_m:.3g} m"
            )
    elif camera is not None:
        if camera.half_fov_rad == 0.0:
            raise RendezviewError(
                "the camera's boresight lies outside its picture, so its field of view says "
                "nothing of the sphere: give the sphere radius"
            )
        radii = 1.0 / np.sin(_FILL * camera.half_fov_rad)
        radius_m = float(max(radii, _LEAST_RADII)) * target_radius_m
    else:
        radius_m = DEFAULT_RADII * target_radius_m
    if options.contour_points and options.contour_radii[0] * radius_m <= 1.02 * target_radius_m:
        raise RendezviewError(
            f"a shell of {options.contour_radii[0] * radius_m:.3g} m does not enclose the target, "
            f"whose own radius is {target_radius_m:.3g} m: the least shell is "
            f"{1.02 * target_radius_m / radius_m:.2f} sphere radii"
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
