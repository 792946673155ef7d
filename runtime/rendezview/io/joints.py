"""The ``[[joints]]`` of a target file: parts that turn, and which parts of the mesh they are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.geometry.joint import Hinge, Joint
from rendezview.geometry.pose import Array

# Of a turn; a range this near to the period covers it.
_WHOLE = 1e-6  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class HingedParts:
    """The parts of the mesh that turn about one hinge."""

    nodes: tuple[str, ...] = ()  # names of nodes of the mesh file's scene; * and ? as in file names
    boxes_m: tuple[Array, ...] = ()  # (2, 3) each, target frame: faces that lie wholly within
    meshes: tuple[Path, ...] = ()  # files of their own, in the target's frame and unit


@dataclass(frozen=True, slots=True, eq=False)
class JointedParts:
    """A joint, and the parts of the mesh that turn with it."""

    joint: Joint
    parts: tuple[HingedParts, ...]  # of each of its hinges


def joint_of(
    where: str,
    name: str,
    hinges: tuple[Hinge, ...],
    limits_deg: list[float],
    symmetry_deg: float | None,
) -> Joint:
    """The joint of a table.

    Raises:
        RendezviewError: the limits are reversed, or wider than a turn; the symmetry divides no
            full turn. ``where`` and ``name`` say which.
    """
    low, high = limits_deg
    if not low < high:
        raise RendezviewError(
            f"{where}: joint {name!r}: limits_deg = [{low:g}, {high:g}] must rise"
        )
    if high - low > 360.0 * (1.0 + _WHOLE):
        raise RendezviewError(f"{where}: joint {name!r}: limits_deg span more than a full turn")
    period_deg = 360.0 if symmetry_deg is None else symmetry_deg
    turns = 360.0 / period_deg
    if abs(turns - round(turns)) > 1e-6 or turns > 36:
        raise RendezviewError(
            f"{where}: joint {name!r}: symmetry_deg = {period_deg:g} must divide a full turn"
        )
    whole = high - low >= period_deg * (1.0 - _WHOLE)
    if whole:
        high = low + period_deg
    return Joint(
        name,
        hinges,
        math.radians(low),
        math.radians(high),
        math.radians(period_deg) if whole else None,
    )
