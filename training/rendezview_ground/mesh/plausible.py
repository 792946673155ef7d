"""Questions sizes of meshes that no spacecraft has; for cameras and times, ``io/plausible.py``.

A unit that is given, by the user or by the file, is believed: `--unit` says that a size is meant.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.target import METRES_PER_UNIT
from rendezview_ground.mesh.bounding_sphere import smallest_enclosing_sphere
from rendezview_ground.mesh.mesh_file import MeshFile

# Diameters outside these ranges mean a wrong unit. The narrow range applies where the unit is a
# guess or a convention of the format, the wide one where it is stated.
GUESSED_DIAMETER_M = (0.05, 120.0)  # m; the International Space Station has 110
STATED_DIAMETER_M = (0.005, 1000.0)  # m
STATION_M = 60.0  # m; larger than all craft but stations. Source: Mir had 33
LIKELY_M = (0.1, 40.0)  # m: from a CubeSat to a shuttle


def metres_per_unit(
    path: Path, vertices: Array, content: MeshFile, unit: str | None
) -> tuple[float, str, tuple[str, ...]]:
    """Metres per unit of the file, the note that states its origin, and what is odd about it.

    Raises:
        RendezviewError: no spacecraft has this size.
    """
    diameter = 2.0 * smallest_enclosing_sphere(vertices)[1]
    extent = np.ptp(vertices, axis=0)
    limits, source = STATED_DIAMETER_M, ""
    if unit is not None:
        factor = METRES_PER_UNIT[unit]
        source = f"Unit {unit} as given"
        if content.unit is not None and not np.isclose(content.unit[0], factor):
            source += f", not {content.unit[1]} as the file states"
    elif content.unit is not None:
        factor = content.unit[0]
        source = f"Unit from the file: {content.unit[1]}"
        if path.suffix.lower() in (".glb", ".gltf"):
            limits = GUESSED_DIAMETER_M  # a convention of the format, not a statement of the author
    else:
        factor, limits = 1.0, GUESSED_DIAMETER_M
    if not limits[0] <= diameter * factor <= limits[1]:
        raise RendezviewError(_absurd_size(path, diameter, factor, source))
    doubts: tuple[str, ...] = ()
    if limits is GUESSED_DIAMETER_M and diameter * factor > STATION_M:
        doubts = (
            f"{diameter * factor:.4g} m across is the size of a space station; "
            f"{_others(diameter)}. Give --unit (m if it is meant).",
        )
    size = " × ".join(f"{value:.{_decimals(diameter * factor)}f}" for value in extent * factor)
    if source:
        return factor, f"{source}: {size} m.", doubts
    words = f"No unit in the file: taken as metres, {size} m; give --unit mm if that is wrong."
    return factor, words, doubts


def _absurd_size(path: Path, diameter: float, factor: float, source: str) -> str:
    said = source or "No unit in the file, and metres do not fit"
    return (
        f"{path}: the target would be {diameter * factor:.4g} m across. {said}. "
        f"Give the right unit (--unit): {_others(diameter)}."
    )


def _others(diameter: float) -> str:
    """The diameter in every unit, and which of them are those of spacecraft."""
    sizes = {name: diameter * metres for name, metres in METRES_PER_UNIT.items()}
    likely = [name for name, size_m in sizes.items() if LIKELY_M[0] <= size_m <= LIKELY_M[1]]
    listed = ", ".join(f"{name}: {size_m:.4g} m" for name, size_m in sizes.items())
    return f"the diameter would be {listed}" + (
        f"; {' or '.join(likely)} would be a spacecraft" if likely else ""
    )


def _decimals(diameter_m: float) -> int:
    return 2 if diameter_m >= 1.0 else 3 if diameter_m >= 0.1 else 4
