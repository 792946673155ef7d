"""Models of a BOP data set: ``models/obj_000001.ply`` with its entry in ``models_info.json``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose, nearest_rotation
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.files import checked, read_json
from rendezview_ground.evaluate.surface import combined, turns_about

_NAME = re.compile(r"obj_(\d+)\.ply", re.IGNORECASE)
_INFO = "models_info.json"
_AT_ORIGIN = 1e-3  # of the diameter; tolerance, because the files are rounded


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
    symmetries: tuple[Symmetry, ...]  # symmetries about the origin
    off_origin: int  # number of other symmetries


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
        try:
            discrete.append(Pose(nearest_rotation(matrix[:3, :3]), matrix[:3, 3] / 1000.0))
        except ValueError as error:
            raise RendezviewError(
                f"{info_path}: {obj_id}.symmetries_discrete: {error}: correct the file"
            ) from error
    near_m = _AT_ORIGIN * info.diameter / 1000.0
    symmetries, continuous, off_origin = [], [], 0
    for turn in discrete[1:]:
        vector = Rotation.from_matrix(turn.rotation).as_rotvec()
        angle = float(np.linalg.norm(vector))
        if angle > 0.0 and np.linalg.norm(turn.translation_m) < near_m:
            symmetries.append(Symmetry("discrete", vector / angle, angle))
        else:
            off_origin += 1
    for entry in info.symmetries_continuous:
        axis, offset_m = np.asarray(entry.axis), np.asarray(entry.offset) / 1000.0
        length = float(np.linalg.norm(axis))
        if not length > 0.0:
            raise RendezviewError(f"{info_path}: {obj_id}: an axis is zero: correct the file")
        axis = axis / length
        continuous += turns_about(axis, offset_m)
        if np.linalg.norm(np.cross(axis, offset_m)) < near_m:
            symmetries.append(Symmetry("continuous", axis, None))
        else:
            off_origin += 1
    return BopModel(
        obj_id,
        info.diameter / 1000.0,
        combined(discrete, continuous),
        tuple(symmetries),
        off_origin,
    )
