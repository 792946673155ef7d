"""The record of a laboratory calibration as a JSON file."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field, FiniteFloat, TypeAdapter

from rendezview.calibration.laboratory import CameraRecord, LaboratoryRecord, PlateView
from rendezview.errors import explained
from rendezview.geometry.pose import Array
from rendezview.io.files import StrPath, checked, read_json
from rendezview.sensors.beacons.rig_files import PoseTable, Table

_Numbers = list[FiniteFloat]
_Rows = list[_Numbers]
_Positive = Annotated[FiniteFloat, Field(gt=0.0)]


class _CameraTable(Table):
    name: Annotated[str, Field(min_length=1)]
    focal_m: _Positive
    half_width_m: _Positive
    beam_m: _Rows
    scan: list[_Rows]
    principal_beam: _Rows
    lens_beam: _Rows


class _ViewTable(Table):
    rig_from_plate: PoseTable | None
    currents: list[list[_Numbers | None] | None]
    frames: Annotated[int, Field(gt=0)]


class _Record(Table):
    cameras: Annotated[list[_CameraTable], Field(min_length=1)]
    plate_m: _Rows
    plate_sigma_m: _Positive
    views: Annotated[list[_ViewTable], Field(min_length=1)]


_RECORD = TypeAdapter(_Record)


def load_record(path: StrPath) -> LaboratoryRecord:
    """Read a record.

    Raises:
        RendezviewError: missing, not a record, or tables of unequal lengths (named).
    """
    content = read_json(path, "the record of a laboratory calibration (JSON)")
    file = checked(_RECORD, content, str(path))
    with explained(f"{path}: ", ": correct the record"):
        plate = _table(file.plate_m, (-1, 3), "plate_m")
        cameras = tuple(
            CameraRecord(
                one.name, one.focal_m, one.half_width_m, _table(one.beam_m, (-1, 2), "beam_m"),
                _table(one.scan, (-1, len(one.beam_m), 4), "scan"),
                _table(one.principal_beam, (-1, 4), "principal_beam"),
                _table(one.lens_beam, (-1, 4), "lens_beam"),
            )
            for one in file.cameras
        )  # fmt: skip
        views = []
        for number, view in enumerate(file.views):
            if len(view.currents) != len(cameras):
                raise ValueError(f"views.{number}.currents: needs one entry for each camera")
            seen = tuple(
                None
                if rows is None
                else _table(
                    [row or [np.nan] * 4 for row in rows], (len(plate), 4), f"views.{number}"
                )
                for rows in view.currents
            )
            place = None if view.rig_from_plate is None else view.rig_from_plate.pose()
            views.append(PlateView(place, seen, view.frames))
    return LaboratoryRecord(cameras, plate, file.plate_sigma_m, tuple(views))


def _table(rows: Any, shape: tuple[int, ...], what: str) -> Array:
    try:
        array = np.array(rows, dtype=np.float64)
    except ValueError:
        raise ValueError(f"{what}: its rows have unequal lengths") from None
    fits = array.ndim == len(shape) and all(
        want in (-1, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{what}: must be {shape} numbers (-1: any), not {array.shape}")
    return array
