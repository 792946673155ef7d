"""The view model: the result of training, which the craft carries."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import explained
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.joint import Joint, apart
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.target import DockingRing, Reflector
from rendezview.sensors.appearance.model.container import (
    check_shapes,
    read_container,
    write_container,
)
from rendezview.sensors.appearance.model.contours import Contours, surfaces_of_cells
from rendezview.sensors.appearance.model.forest import ForestScores, ScoreForest
from rendezview.sensors.appearance.model.near_views import NearSphere
from rendezview.sensors.appearance.model.shadowed_silhouettes import ShadowedSilhouettes
from rendezview.sensors.appearance.model.shape import SHAPE_RELIEF, Shape
from rendezview.sensors.appearance.model.sketches import ViewSketches
from rendezview.sensors.appearance.model.surface import Surface
from rendezview.sensors.appearance.model.trees import Forest
from rendezview.sensors.beam import BeamMesh

# sphere radii, range of the far readings: perspective is weak there. Source:
# docs/notes/trajectory.md, interpolation
FAR_RADII = 4.0
# Thousandths, unit of the stored change from near to far readings.
FAR_UNIT = 5.0  # Source: by construction, format of the model file


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The views of the half-edge lattice, nodes first, each centred on its silhouette."""

    centred_from_target: Array  # (V, 3, 3) attitude of the camera turned to the centroid
    readings: npt.NDArray[np.uint16]  # (V, N) signature in thousandths of sqrt(area)
    area_m2: Array  # (V,) area_sr × range² at the sphere radius: A_ref of eq. 4
    area_slope: Array  # (V,) relative change of area_sr × range² with sphere radius / range
    offset_m: Array  # (V, 2) view centre off the centroid's line of sight, x right, y down
    far_change: npt.NDArray[np.int8] | None = None  # see ``far_readings``; None: not stored

    @property
    def far_readings(self) -> Array | None:
        """(V, N) readings from ``FAR_RADII`` sphere radii, to a few thousandths; or None."""
        if self.far_change is None:
            return None
        bins = self.readings.shape[1]
        change = FAR_UNIT * np.repeat(self.far_change, 2, axis=1)[:, :bins].astype(np.float64)
        return np.asarray(self.readings + change)

    def with_far(self, far_readings: npt.NDArray[Any]) -> Views:
        """These views with readings (V, N) from afar, kept as the change of two bins at a time."""
        change = far_readings.astype(np.float64) - self.readings
        odd = change.shape[1] % 2
        change = np.pad(change, ((0, 0), (0, odd)), mode="edge")
        pairs = change.reshape(len(change), -1, 2).mean(axis=2) / FAR_UNIT
        return replace(self, far_change=np.clip(np.rint(pairs), -127, 127).astype(np.int8))


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Errors of recognition on perturbed views that training never saw, root mean square.

    Wrong answers are left out; see ``rendezview_ground.learn.trees.calibrate``.
    """

    direction_rad: float  # view direction, each of two axes
    roll_rad: float  # about the line of sight
    range_fraction: float
    bearing_rad: float  # of the view centre, times range over sphere radius, each axis
    residual: float  # of the readings against the most alike view: 99.5 % were below


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ViewModel:
    """A geodesic sphere of views of one target, with a decision tree for each node.

    The view centre is the point that every view looks at, the middle of the target's
    bounding sphere; poses are nevertheless those of the target's own (CAD) frame.
    """

    name: str
    order: int  # of the node sphere; the views are those of order + 1
    sphere_radius_m: float  # distance of the views from the view centre
    target_radius_m: float  # of the bounding sphere
    centre_m: Array  # (3,) view centre in the target frame
    smooth_bins: int
    views: Views
    forest: Forest
    leaf_on: npt.NDArray[np.int32]  # (M,) training samples in the leaf, recognised …
    leaf_off: npt.NDArray[np.int32]  # (M,) … and not
    training_accuracy: Array  # (T,) share of right decisions on the training samples
    held_out_accuracy: Array  # (T,) the same on held-out samples; NaN where not measured
    held_out: HeldOut
    contours: Contours | None  # for refinement; None: trained without
    lit: ShadowedSilhouettes | None  # for first poses in hard light; None: trained without
    symmetries: tuple[Symmetry, ...]  # turns that change nothing
    provenance: dict[str, Any]  # mesh, options, seed, versions: how the model was made
    shape_error: float = 0.0  # σ of the strain by which the mesh may differ from the craft
    surface: Surface | None = None  # points and albedo, for shading; None: trained without
    score_forest: ScoreForest | None = (
        None  # order and confirm first poses; None: trained without, or earlier
    )
    sketches: ViewSketches | None = None  # for photographs; None: trained without, or earlier
    shape: Shape | None = None  # of rivals; None: trained without, or earlier
    # (6, 6) of the strain that calibration left: xx, yy, zz, xy, xz, yz; None: not calibrated
    shape_covariance: Array | None = None
    # As the target file has them, for the sensors beside this one.
    docking_ring: DockingRing | None = None
    reflectors: tuple[Reflector, ...] = ()
    near: tuple[NearSphere, ...] = ()  # of the part around the docking ring; (): trained without
    # Of a target with joints: the mesh is at these angles, and ``configurations`` are the same
    # target at others, with the same view centre and radius.
    joints: tuple[Joint, ...] = ()
    angles_rad: Array = field(default_factory=lambda: np.zeros(0))  # (J,)
    configurations: tuple[ViewModel, ...] = ()

    def __repr__(self) -> str:
        nodes, radius_m = len(self.held_out_accuracy), round(self.target_radius_m, 4)
        return f"ViewModel({self.name!r}, nodes={nodes}, target_radius_m={radius_m})"

    def configuration_at(self, angles_rad: Array) -> ViewModel:
        """The configuration whose angles are nearest to some angles (J,); itself without joints."""
        if not self.joints:
            return self

        def farthest(configuration: ViewModel) -> float:
            return float(np.abs(apart(self.joints, configuration.angles_rad, angles_rad)).max())

        return min((self, *self.configurations), key=farthest)

    @property
    def shape_uncertainty(self) -> Array:
        """(6, 6) covariance of the strain between model and craft, shears times √2."""
        known = np.zeros((6, 6)) if self.shape_covariance is None else self.shape_covariance
        factors = np.array([1.0] * 3 + [np.sqrt(2.0)] * 3)
        return np.asarray(factors[:, None] * known * factors + self.shape_error**2 * np.eye(6))

    @property
    def bins(self) -> int:
        """Number of readings in a signature."""
        return int(self.views.readings.shape[1])

    def beam_mesh(self) -> BeamMesh | None:
        """The shape in the target frame, for a ranger's beam; None: trained without, or jointed."""
        if self.shape is None or self.joints:
            return None
        relief_m = self.target_radius_m * math.hypot(SHAPE_RELIEF, self.shape_error)
        return BeamMesh(self.shape.vertices_m + self.centre_m, self.shape.faces, relief_m)

    @property
    def geodesic(self) -> Geodesic:
        """The sphere of nodes."""
        return Geodesic.of_order(self.order)

    def forest_scores(self) -> ForestScores | None:
        """Of the forest; None where there are none."""
        if self.score_forest is None:
            return None
        nodes = self.geodesic.nodes
        rotations = self.views.centred_from_target[: len(nodes)]
        return ForestScores(self.score_forest, nodes, rotations, self.geodesic.mean_edge_rad)

    @property
    def lattice(self) -> Geodesic:
        """The sphere of views: nodes and the mid-points of their edges."""
        return Geodesic.of_order(self.order + 1)

    def save(self, path: Path | str) -> None:
        """Write the model file, atomically and byte for byte reproducibly."""
        header, arrays = self._stored()
        for k, configuration in enumerate(self.configurations):
            its_header, its_arrays = configuration._stored()
            header.setdefault("sheets", []).append(its_header)
            arrays |= {f"sheet{k}.{name}": array for name, array in its_arrays.items()}
        write_container(Path(path), header, arrays)

    @classmethod
    def load(cls, path: Path | str) -> ViewModel:
        """Read a model file.

        Raises:
            RendezviewError: the file is missing, of another kind, newer, cut off,
                damaged, or does not hold together.
        """
        path = Path(path)
        header, arrays = read_container(path)
        faults = (KeyError, TypeError, ValueError, IndexError)
        broken = f"{path}: the model does not hold together ("
        with explained(broken, "); train it again", faults):
            return cls._of(header, arrays)

    def _stored(self) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
        """Header and arrays of the file, without the other configurations."""
        arrays: dict[str, npt.NDArray[Any]] = {name: getattr(self, name) for name in _ARRAYS}
        for own_name, (name, _) in _PARTS.items():
            part = getattr(self, own_name)
            if part is None:
                continue
            values = {f.name: getattr(part, f.name) for f in fields(part)}
            arrays |= {f"{name}.{n}": value for n, value in values.items() if value is not None}
        for k, sphere in enumerate(self.near):
            arrays |= {f"near{k}.{n}": array for n, array in sphere.arrays().items()}
        header = {
            "name": self.name,
            "order": self.order,
            "sphere_radius_m": self.sphere_radius_m,
            "target_radius_m": self.target_radius_m,
            "smooth_bins": self.smooth_bins,
            "held_out": {f.name: getattr(self.held_out, f.name) for f in fields(HeldOut)},
            "symmetries": [symmetry.record() for symmetry in self.symmetries],
            "shape_error": self.shape_error,
            "provenance": self.provenance,
        }
        if self.shape_covariance is not None:
            header["shape_covariance"] = self.shape_covariance.tolist()
        if self.docking_ring is not None:
            header["docking_ring"] = self.docking_ring.record()
        if self.near:
            header["near"] = [sphere.header() for sphere in self.near]
        if self.reflectors:
            header["reflectors"] = [reflector.record() for reflector in self.reflectors]
        if self.joints:
            header["joints"] = [joint.record() for joint in self.joints]
            header["angles_rad"] = self.angles_rad.tolist()
        return header, arrays

    @classmethod
    def _of(cls, header: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> ViewModel:
        """The model of ``_stored``, with its configurations."""
        # Files of earlier versions have edge profiles of cells.
        if "contours.strip" in arrays and "contours.start" not in arrays:
            cells, kind = arrays["contours.strip"], arrays["contours.kind"]
            arrays["contours.strip"], arrays["contours.start"] = surfaces_of_cells(cells, kind)
            arrays.pop("contours.rim", None)
        configurations = header.get("sheets", [])
        parts: dict[str, Any] = {name: arrays[name] for name in _ARRAYS}
        parts |= {own: _part(arrays, name, kind) for own, (name, kind) in _PARTS.items()}
        model = cls(
            name=str(header["name"]),
            order=int(header["order"]),
            sphere_radius_m=float(header["sphere_radius_m"]),
            target_radius_m=float(header["target_radius_m"]),
            smooth_bins=int(header["smooth_bins"]),
            held_out=HeldOut(**header["held_out"]),
            symmetries=tuple(Symmetry.of_record(s) for s in header.get("symmetries", [])),
            shape_error=float(header.get("shape_error", 0.0)),
            shape_covariance=_shape_covariance(header),
            docking_ring=DockingRing.of_record(header["docking_ring"])
            if "docking_ring" in header
            else None,
            reflectors=tuple(Reflector.of_record(r) for r in header.get("reflectors", [])),
            near=tuple(
                NearSphere.stored(sphere, _below(arrays, f"near{k}."))
                for k, sphere in enumerate(header.get("near", []))
            ),
            joints=tuple(Joint.of_record(joint) for joint in header.get("joints", [])),
            angles_rad=np.array(header.get("angles_rad", []), dtype=np.float64),
            configurations=tuple(
                cls._of(configuration, _below(arrays, f"sheet{k}."))
                for k, configuration in enumerate(configurations)
            ),
            provenance=dict(header["provenance"]),
            **parts,
        )
        model._check()
        return model

    def _check(self) -> None:
        count, nodes = len(self.lattice.nodes), len(self.geodesic.nodes)
        leaves = self.forest.component.shape
        check_shapes(
            "views", self.views, centred_from_target=(count, 3, 3), readings=(count, self.bins),
            area_m2=(count,), area_slope=(count,), offset_m=(count, 2),
        )  # fmt: skip
        if self.views.far_change is not None:
            check_shapes("views", self.views, far_change=(count, (self.bins + 1) // 2))
        check_shapes("forest", self.forest, roots=(nodes,))
        check_shapes(
            "model", self, centre_m=(3,), leaf_on=leaves, leaf_off=leaves,
            training_accuracy=(nodes,), held_out_accuracy=(nodes,),
        )  # fmt: skip
        if self.contours is not None:
            self.contours.check(count)
        if self.lit is not None:
            self.lit.check(count)
        if self.score_forest is not None:
            self.score_forest.check(nodes)
        for part in (*self.near, self.surface, self.sketches, self.shape):
            if part is not None:
                part.check()
        if len(self.angles_rad) != len(self.joints):
            raise ValueError(f"{len(self.angles_rad)} angles of {len(self.joints)} joints")
        for configuration in self.configurations:
            if len(configuration.joints) != len(self.joints) or configuration.order != self.order:
                raise ValueError("its configurations are of different targets")
        if self.forest.component.max(initial=-1) >= self.bins:
            raise ValueError("a tree looks at a bin beyond the signature")


def _shape_covariance(header: dict[str, Any]) -> Array | None:
    """Of calibrated models."""
    if "shape_covariance" not in header:
        return None
    covariance = np.array(header["shape_covariance"], dtype=np.float64)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError("shape_covariance must be 6 × 6 finite numbers")
    return covariance


def _part(arrays: dict[str, npt.NDArray[Any]], name: str, kind: type[Any]) -> Any:
    """A part of a model, None where it has none; all have views and a forest."""
    found = _below(arrays, f"{name}.")
    return kind(**found) if found or name in ("views", "forest") else None


def _below(arrays: dict[str, npt.NDArray[Any]], start: str) -> dict[str, npt.NDArray[Any]]:
    """The arrays whose names begin so, under the rest of their names."""
    return {key.removeprefix(start): a for key, a in arrays.items() if key.startswith(start)}


# Fields: their names in the file, and types. Source: by construction, format of the model file
_PARTS: dict[str, tuple[str, type[Any]]] = {
    "views": ("views", Views),
    "forest": ("forest", Forest),
    "contours": ("contours", Contours),
    "lit": ("lit", ShadowedSilhouettes),
    "surface": ("surface", Surface),
    "score_forest": ("voters", ScoreForest),
    "sketches": ("sketches", ViewSketches),
    "shape": ("shape", Shape),
}
_ARRAYS = ("centre_m", "leaf_on", "leaf_off", "training_accuracy", "held_out_accuracy")
