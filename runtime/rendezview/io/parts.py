"""The ``[[parts]]`` of a target file: parts of the mesh that are not as the craft has them."""

from __future__ import annotations

from dataclasses import dataclass

from rendezview.geometry.pose import Array


@dataclass(frozen=True, slots=True, eq=False)
class TrustedPart:
    """A part of the mesh, how far it is trusted, and what covers it."""

    name: str
    trust: float = 1.0  # 0: its edges are not used, 1: like the others
    insulation_m: float = 0.0  # mean thickness of a blanket over it
    nodes: tuple[str, ...] = ()  # names of nodes of the mesh file's scene; * and ? as in file names
    boxes_m: tuple[Array, ...] = ()  # (2, 3) each, target frame: faces that lie wholly within
