"""The target vehicle: its mesh file and its other data, from ``target.toml``.

Everything but the mesh is in the target frame, in metres, for any unit of the mesh.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    StringConstraints,
    TypeAdapter,
)

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.joint import Hinge
from rendezview.geometry.symmetry import Symmetry, common_point, discrete_turns
from rendezview.io.files import StrPath, checked, read_toml
from rendezview.io.joints import HingedParts, JointedParts, joint_of
from rendezview.io.parts import TrustedPart
from rendezview.io.results import json_value

Array = npt.NDArray[np.float64]

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}

TARGET_FILE = "target.toml"


@dataclass(frozen=True, slots=True, eq=False)
class DockingRing:
    """A circular ring (launch adapter, docking port)."""

    centre_m: Array  # (3,)
    axis: Array  # (3,) unit, outward normal of the ring's plane
    radius_m: float
    # Other circles about the same axis, whose pattern tells which circle of a picture is the ring:
    # height over the ring's plane (m, outwards positive) and radius (m).
    circles: tuple[tuple[float, float], ...] = ()

    def record(self) -> dict[str, Any]:
        """As JSON."""
        return dict(json_value(self))

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> DockingRing:
        """The inverse of `record`."""
        circles = tuple((float(h), float(r)) for h, r in record["circles"])
        centre, axis = _frozen(record["centre_m"]), _frozen(record["axis"])
        return cls(centre, axis, float(record["radius_m"]), circles)


@dataclass(frozen=True, slots=True, eq=False)
class Reflector:
    """A retro-reflector; those of one ``group`` are searched together."""

    name: str
    group: str
    position_m: Array  # (3,)
    normal: Array  # (3,) unit, outward
    diameter_m: float
    position_sigma_m: float | None = None  # σ of each coordinate of its place; None: not known

    def record(self) -> dict[str, Any]:
        """As JSON."""
        return dict(json_value(self))

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> Reflector:
        """The inverse of `record`."""
        place, normal = _frozen(record["position_m"]), _frozen(record["normal"])
        return cls(**{**record, "position_m": place, "normal": normal})


@dataclass(frozen=True, slots=True, eq=False)
class Led:
    """A light of the target."""

    name: str
    position_m: Array  # (3,)
    normal: Array  # (3,) unit, along the beam
    position_sigma_m: float | None = None  # σ of each coordinate of its place; None: not known


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A target vehicle; positions and directions are in the target frame, metres."""

    name: str
    description: str
    mesh: Path | None  # None: only lights or reflectors are known
    unit: str | None  # a key of METRES_PER_UNIT; None: not known
    docking_ring: DockingRing | None = None
    reflectors: tuple[Reflector, ...] = ()
    leds: tuple[Led, ...] = ()
    symmetries: tuple[Symmetry, ...] = ()
    shape_error: float = 0.0  # σ of the strain between mesh and craft
    joints: tuple[JointedParts, ...] = ()  # parts that turn
    parts: tuple[TrustedPart, ...] = ()  # parts that are less trusted than the others
    source: Path | None = None  # its target file

    @property
    def mesh_path(self) -> Path:
        """The mesh file, with ``#NODE`` after it if only a node of its scene is the target.

        Raises:
            RendezviewError: the target has none.
        """
        if self.mesh is None:
            raise RendezviewError(
                f"target {self.name!r} has no mesh, which is needed here: add [mesh] with path and "
                "unit to its target file"
            )
        return self.mesh

    @classmethod
    def load(cls, path: StrPath) -> Target:
        """Read a ``*.toml`` target file, a folder with a ``target.toml``, or a bare mesh.

        A bare mesh has its file name as name, and its unit is None.

        Raises:
            RendezviewError: missing, not TOML, an unknown or wrong key (named), or
                the mesh file is not where the target file names it.
        """
        given = Path(path)
        if given.is_dir():
            given = given / TARGET_FILE
            if not given.is_file():
                raise RendezviewError(
                    f"{path}: this folder has no {TARGET_FILE}: give a target file or a mesh file"
                )
        if given.suffix.lower() == ".toml":
            return _read_target(given)
        file, node = split_node(given)
        if not file.is_file():
            raise RendezviewError(
                f"{path}: no such file: give a {TARGET_FILE}, a folder with one, or a mesh file"
            )
        return cls(name=node or given.stem, description="", mesh=given, unit=None)


def split_node(path: Path) -> tuple[Path, str | None]:
    """File and node of ``FILE#NODE``; a file whose own name has a # is not split."""
    name, mark, node = path.name.rpartition("#")
    if not mark or not name or not node or path.exists():
        return path, None
    return path.with_name(name), node


def _frozen(values: list[float]) -> Array:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _direction(values: list[float]) -> list[float]:
    scale = max(abs(value) for value in values)
    if scale == 0.0:
        raise ValueError("a direction must not be zero")
    scaled = [value / scale for value in values]
    norm = math.hypot(*scaled)
    return [value / norm for value in scaled]


_Name = Annotated[str, StringConstraints(min_length=1)]
_Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Direction = Annotated[_Vector, AfterValidator(_direction)]
_Length = Annotated[FiniteFloat, Field(gt=0.0)]
_Sigma = Annotated[FiniteFloat, Field(ge=0.0)]
_Boxes = list[Annotated[list[_Vector], Field(min_length=2, max_length=2)]]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _MeshTable(_Table):
    path: _Name
    unit: Literal["m", "cm", "mm", "in", "ft"]
    shape_error: Annotated[FiniteFloat, Field(ge=0.0, le=0.2)] = 0.0


class _CircleTable(_Table):
    height_m: FiniteFloat
    radius_m: _Length


class _RingTable(_Table):
    centre_m: _Vector
    axis: _Direction
    radius_m: _Length
    circles: list[_CircleTable] = []


class _LedTable(_Table):
    name: _Name
    position_m: _Vector
    normal: _Direction
    position_sigma_m: _Sigma | None = None


class _ReflectorTable(_LedTable):
    group: _Name
    diameter_m: _Length


class _HingeTable(_Table):
    axis: _Direction
    origin_m: _Vector
    nodes: list[_Name] = []
    boxes_m: _Boxes = []
    meshes: list[_Name] = []


class _JointTable(_HingeTable):
    name: _Name
    limits_deg: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
    symmetry_deg: Annotated[FiniteFloat, Field(gt=0.0, le=360.0)] | None = None
    others: list[_HingeTable] = []


class _PartTable(_Table):
    name: _Name
    trust: Annotated[FiniteFloat, Field(ge=0.0, le=1.0)] = 1.0
    insulation_m: Annotated[FiniteFloat, Field(ge=0.0)] = 0.0
    nodes: list[_Name] = []
    boxes_m: _Boxes = []


class _DiscreteTable(_Table):
    kind: Literal["discrete"]
    axis: _Direction
    angle_rad: Annotated[FiniteFloat, Field(gt=0.0, lt=math.tau)]
    point_m: _Vector = [0.0, 0.0, 0.0]


class _ContinuousTable(_Table):
    kind: Literal["continuous"]
    axis: _Direction
    point_m: _Vector = [0.0, 0.0, 0.0]


class _TargetFile(_Table):
    name: _Name
    description: str = ""
    mesh: _MeshTable | None = None  # lights and reflectors do without
    docking_ring: _RingTable | None = None
    reflectors: list[_ReflectorTable] = []
    leds: list[_LedTable] = []
    symmetries: list[Annotated[_DiscreteTable | _ContinuousTable, Field(discriminator="kind")]] = []
    joints: list[_JointTable] = []
    parts: list[_PartTable] = []


_TARGET_FILE = TypeAdapter(_TargetFile)


def _read_target(path: Path) -> Target:
    file = checked(_TARGET_FILE, read_toml(path, "a target file"), str(path))
    for key in ("reflectors", "leds", "joints", "parts"):
        _refuse_twice(path, key, [table.name for table in getattr(file, key)])
    mesh_path = None
    if file.mesh is not None:
        mesh_path = Path(os.path.normpath(path.parent / file.mesh.path))
    elif not (file.reflectors or file.leds or file.docking_ring):
        raise RendezviewError(
            f"{path}: no [mesh], and no [[reflectors]], [[leds]] or [docking_ring] either: say "
            "what the target looks like"
        )
    if mesh_path is not None and not split_node(mesh_path)[0].is_file():
        raise RendezviewError(
            f"{path}: mesh.path: there is no file {mesh_path}: correct the path "
            f"(relative to the target file) or put the mesh there"
        )
    ring = file.docking_ring
    return Target(
        name=file.name,
        description=file.description,
        mesh=mesh_path,
        unit=None if file.mesh is None else file.mesh.unit,
        shape_error=0.0 if file.mesh is None else file.mesh.shape_error,
        docking_ring=None if ring is None else _ring(ring),
        reflectors=tuple(Reflector(**_placed(table)) for table in file.reflectors),
        leds=tuple(Led(**_placed(table)) for table in file.leds),
        symmetries=_symmetries(path, file.symmetries),
        joints=tuple(_joint(path, joint) for joint in file.joints),
        parts=tuple(_part(path, part) for part in file.parts),
        source=path,
    )


def _symmetries(
    path: Path, tables: Sequence[_DiscreteTable | _ContinuousTable]
) -> tuple[Symmetry, ...]:
    symmetries = tuple(
        Symmetry(t.kind, _frozen(t.axis), getattr(t, "angle_rad", None), _frozen(t.point_m))
        for t in tables
    )
    with explained(f"{path}: symmetries: ", ": correct them"):
        discrete_turns(symmetries)
        common_point(symmetries)
    return symmetries


def _joint(path: Path, table: _JointTable) -> JointedParts:
    tables = [table, *table.others]
    hinges = tuple(Hinge(np.array(t.axis), np.array(t.origin_m)) for t in tables)
    joint = joint_of(str(path), table.name, hinges, table.limits_deg, table.symmetry_deg)
    where = f"{path}: joint {table.name!r}"
    return JointedParts(joint, tuple(_hinged(where, path.parent, t) for t in tables))


def _hinged(where: str, folder: Path, table: _HingeTable) -> HingedParts:
    if not (table.nodes or table.boxes_m or table.meshes):
        raise RendezviewError(f"{where} has no parts: give nodes, boxes_m or meshes")
    meshes = tuple(Path(os.path.normpath(folder / name)) for name in table.meshes)
    for mesh in meshes:
        if not split_node(mesh)[0].is_file():
            raise RendezviewError(f"{where}: there is no file {mesh}")
    return HingedParts(tuple(table.nodes), _boxes(where, table.boxes_m), meshes)


def _part(path: Path, table: _PartTable) -> TrustedPart:
    where = f"{path}: part {table.name!r}"
    if not (table.nodes or table.boxes_m):
        raise RendezviewError(f"{where} is nowhere: give nodes or boxes_m")
    boxes = _boxes(where, table.boxes_m)
    return TrustedPart(table.name, table.trust, table.insulation_m, tuple(table.nodes), boxes)


def _boxes(where: str, corners: list[list[list[float]]]) -> tuple[Array, ...]:
    boxes = tuple(np.array(box, dtype=np.float64) for box in corners)
    for low, high in boxes:
        if not np.all(low < high):
            raise RendezviewError(f"{where}: boxes_m must be [lowest, highest] corners")
    return boxes


def _placed(table: _LedTable) -> dict[str, Any]:
    place, normal = _frozen(table.position_m), _frozen(table.normal)
    return {**dict(table), "position_m": place, "normal": normal}


def _ring(table: _RingTable) -> DockingRing:
    circles = tuple((circle.height_m, circle.radius_m) for circle in table.circles)
    return DockingRing(_frozen(table.centre_m), _frozen(table.axis), table.radius_m, circles)


def _refuse_twice(path: Path, key: str, names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RendezviewError(
            f"{path}: {key}: the name {twice[0]!r} is used more than once: give each its own"
        )
