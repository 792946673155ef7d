"""Models of a BOP data set: ``models/obj_000001.ply`` with its entry in ``models_info.json``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Pose, nearest_rotation, rotation_angle
from rendezview.geometry.symmetry import Symmetry, common_point, discrete_turns
from rendezview.io.files import checked, read_json
from rendezview_ground.evaluate.surface import combined, turns_about

_NAME = re.compile(r"obj_(\d+)\.ply", re.IGNORECASE)
_INFO = "models_info.json"
_MISS = 0.01  # of the diameter; axes measured on scans pass beside each other by so much
_KNOWN_RAD = np.deg2rad(1.0)  # a turn so near to one of the others is no new one


class _Continuous(BaseModel):
    model_config = ConfigDict(strict=True)

    axis: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
    offset: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]  # mm


class _Model(BaseModel):
    model_config = ConfigDict(strict=True)

    diameter: Annotated[FiniteFloat, Field(gt=0.0)]  # mm
    symmetries_discrete: list[
        Annotated[list[FiniteFloat], Field(min_length=16, max_length=16)]
    ] = []  # 4 × 4, row-wise, mm
    symmetries_continuous: list[_Continuous] = []


_MODELS = TypeAdapter(dict[str, _Model])


@dataclass(frozen=True, slots=True, eq=False)
class BopModel:
    """BOP's data of a model, in metres."""

    obj_id: int
    diameter_m: float
    alike: tuple[Pose, ...]  # target_from_target of the symmetries, the identity first
    symmetries: tuple[Symmetry, ...]  # that make all its turns
    unused: int  # number of symmetries that no body can have beside these


def bop_model(mesh_path: Path) -> BopModel | None:
    """The entry of a mesh in ``models_info.json``; None if it is not a BOP model.

    Raises:
        RendezviewError: the file is invalid, or has no entry for the object.
    """
    named, info_path = _NAME.fullmatch(mesh_path.name), mesh_path.parent / _INFO
    if named is None or not info_path.is_file():
        return None
    obj_id = int(named[1])
    models = checked(_MODELS, read_json(info_path, "BOP models"), str(info_path))
    info = models.get(str(obj_id))
    if info is None:
        raise RendezviewError(f"{info_path}: has no entry for object {obj_id}: add it")
    discrete = [Pose.identity()]
    for values in info.symmetries_discrete:
        matrix = np.reshape(values, (4, 4))
        if np.allclose(matrix, np.eye(4)):
            continue  # some files list it
        with explained(f"{info_path}: {obj_id}.symmetries_discrete: ", ": correct the file"):
            discrete.append(Pose(nearest_rotation(matrix[:3, :3]), matrix[:3, 3] / 1000.0))
    continuous: list[Pose] = []
    symmetries: list[Symmetry] = []
    for entry in info.symmetries_continuous:
        axis, offset_m = np.asarray(entry.axis), np.asarray(entry.offset) / 1000.0
        length = float(np.linalg.norm(axis))
        if not length > 0.0:
            raise RendezviewError(f"{info_path}: {obj_id}: an axis is zero: correct the file")
        axis = axis / length
        continuous += turns_about(axis, offset_m)
        symmetries.append(Symmetry("continuous", axis, None, offset_m))
    kept, unused = _consistent(symmetries, discrete[1:], info.diameter / 1000.0)
    return BopModel(obj_id, info.diameter / 1000.0, combined(discrete, continuous), kept, unused)


def _consistent(
    continuous: Sequence[Symmetry], discrete: Sequence[Pose], diameter_m: float
) -> tuple[tuple[Symmetry, ...], int]:
    """Symmetries of one body, and how many of the given ones it cannot have beside them.

    Files list all turns of a group, each rounded: those that others make are left out.
    """
    miss_m = _MISS * diameter_m
    kept: list[Symmetry] = []
    unused = 0
    for symmetry in [*continuous, *(_turn(turn, miss_m) for turn in discrete)]:
        if symmetry is None:
            unused += 1
            continue
        try:
            common_point([*kept, symmetry], miss_m)
            if symmetry.angle_rad is not None:
                turns = discrete_turns(kept)
                own = Rotation.from_rotvec(symmetry.axis * symmetry.angle_rad).as_matrix()
                if any(rotation_angle(own @ turn.T) < _KNOWN_RAD for turn in turns):
                    continue
                discrete_turns([*kept, symmetry])
        except ValueError:
            unused += 1
        else:
            kept.append(symmetry)
    if not kept:
        return (), unused
    # One point for all, because rounded axes miss each other.
    centre_m = common_point(kept, miss_m)
    return tuple(replace(symmetry, point_m=centre_m) for symmetry in kept), unused


def _turn(turn: Pose, miss_m: float) -> Symmetry | None:
    """A motion of the target as a turn; None: it also moves the target along the axis."""
    vector = Rotation.from_matrix(turn.rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    if angle < _KNOWN_RAD:
        return None
    axis = vector / angle
    if abs(axis @ turn.translation_m) > miss_m:
        return None
    parts = round(2.0 * np.pi / angle)
    if abs(angle - 2.0 * np.pi / parts) < _KNOWN_RAD:  # exactly, so that its multiples come round
        angle = 2.0 * np.pi / parts
    # t = (I − R) c; across the axis that has one solution.
    point_m = np.linalg.pinv(np.eye(3) - turn.rotation, rcond=1e-6) @ turn.translation_m
    return Symmetry("discrete", axis, angle, point_m)
