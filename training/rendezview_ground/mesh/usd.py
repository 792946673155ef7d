"""USD stages (.usd, .usda, .usdc, .usdz), read by Pixar's library.

All polygon meshes that a renderer would show are taken, in the axes of the stage. Instances are
followed; subdivision surfaces are their control cages.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendezview.errors import optional
from rendezview.geometry.pose import Array
from rendezview_ground.mesh.colours import Rgb, grey
from rendezview_ground.mesh.mesh_file import MeshFile, Part, joined
from rendezview_ground.mesh.notes import counted
from rendezview_ground.mesh.polygon import cut_note, cut_polygons
from rendezview_ground.mesh.scenes import OR_EXPORT, no_such_node

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def read_usd(path: Path, node: str | None) -> MeshFile:
    """The meshes of a stage as one.

    Args:
        path: the file.
        node: name of a prim; it and all below it are read. None: all.

    Raises:
        RendezviewError: the library is not installed, or there is no such prim.
    """
    with optional(f"{path}: USD files need", "usd", instead=OR_EXPORT):
        from pxr import Usd, UsdGeom
    stage = Usd.Stage.Open(str(path))
    metres = float(UsdGeom.GetStageMetersPerUnit(stage))
    stated = stage.HasAuthoredMetadata(UsdGeom.Tokens.metersPerUnit)
    unit = (metres, f"units of {metres:g} m (USD{'' if stated else ', which is its default'})")
    notes = [f"The stage's up axis is {UsdGeom.GetStageUpAxis(stage)}; axes are kept."]
    places, times = UsdGeom.XformCache(), Usd.TimeCode.EarliestTime()
    parts: list[Part] = []
    polygons = concave = cages = others = 0
    for prim in _shown(stage, node, path):
        if not prim.IsA(UsdGeom.Mesh):
            others += prim.IsA(UsdGeom.Gprim)
            continue
        mesh = UsdGeom.Mesh(prim)
        found = _mesh(mesh, np.array(places.GetLocalToWorldTransform(prim)), times)
        if found is None:
            continue
        part, many, hollow = found
        parts.append(part)
        polygons, concave = polygons + many, concave + hollow
        cages += mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none
    if polygons:
        notes.append(cut_note(polygons, concave))
    if cages:
        notes.append(f"{counted(cages, 'subdivision surface')} read as the control cage.")
    if others:
        notes.append(f"{counted(others, 'body')} without triangles (spheres, curves …) ignored.")
    if len(parts) > 1:
        notes.append(f"{len(parts)} bodies joined into one.")
    return joined(parts, unit, notes)


def _shown(stage: Any, node: str | None, path: Path) -> Iterator[Any]:
    """The prims that a renderer would show, all or those of a node, instances included."""
    from pxr import Usd, UsdGeom

    every = list(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))[1:]
    roots = [prim for prim in every if prim.GetName() == node]
    if node is not None and not roots:
        names = [prim.GetName() for prim in every if prim.IsA(UsdGeom.Xformable)]
        raise no_such_node(path, node, "the stage has no prim", names)
    for prim in every:
        place = prim.GetPath()
        if node is not None and not any(place.HasPrefix(root.GetPath()) for root in roots):
            continue
        drawn = UsdGeom.Imageable(prim)
        if (
            drawn
            and drawn.ComputeVisibility() != UsdGeom.Tokens.invisible
            and drawn.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
        ):
            yield prim


def _mesh(mesh: Any, world_from_row: Array, time: Any) -> tuple[Part, int, int] | None:
    """One mesh in the stage's frame, its polygons of more than three corners and concave ones."""
    points = np.array(mesh.GetPointsAttr().Get(time) or (), dtype=np.float64).reshape(-1, 3)
    sizes = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or (), dtype=np.int64)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or (), dtype=np.int64)
    if not len(sizes):
        return None
    if sizes.min() < 0 or sizes.sum() != len(corners):
        raise ValueError(
            f"{mesh.GetPath()}: its faces have {sizes.sum()} of {len(corners)} corners"
        )
    if len(corners) and (corners.min() < 0 or corners.max() >= len(points)):
        raise ValueError(f"{mesh.GetPath()}: a face uses a vertex that is not there")
    sizes[np.array(mesh.GetHoleIndicesAttr().Get(time) or (), dtype=np.int64)] *= -1
    cuts, owners, concave = cut_polygons(points, sizes, corners)
    faces = corners[cuts]
    rgb = _face_rgb(mesh, len(sizes), time)[owners]
    # USD multiplies rows by matrices: p' = p M.
    placed = points @ world_from_row[:3, :3] + world_from_row[3, :3]
    return (placed, faces, rgb), int(np.count_nonzero(sizes > 3)), concave


def _face_rgb(mesh: Any, count: int, time: Any) -> Rgb:
    """Linear colour of each polygon: of its material, else ``displayColor``, else grey."""
    from pxr import UsdShade

    rgb = grey(count)
    shown = mesh.GetDisplayColorPrimvar()
    if shown and shown.HasValue():
        colours = np.array(shown.ComputeFlattened(time), dtype=np.float32).reshape(-1, 3)
        if len(colours) == count and shown.GetInterpolation() == "uniform":
            rgb = colours
        elif len(colours):  # one for all, or of vertices and corners: their mean
            rgb[:] = colours.mean(axis=0)
    binding = UsdShade.MaterialBindingAPI(mesh.GetPrim())
    whole = _diffuse(binding.ComputeBoundMaterial()[0], time)
    if whole is not None:
        rgb[:] = whole
    for subset in binding.GetMaterialBindSubsets():
        own = _diffuse(
            UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0], time
        )
        if own is not None:
            rgb[np.array(subset.GetIndicesAttr().Get(time), dtype=np.int64)] = own
    return rgb


def _diffuse(material: Any, time: Any) -> NDArray[np.float32] | None:
    """The constant diffuse colour of a material's preview surface."""
    if not material:
        return None
    surface = material.ComputeSurfaceSource()[0]
    given = surface.GetInput("diffuseColor") if surface else None
    value = given.Get(time) if given and not given.HasConnectedSource() else None
    return None if value is None else np.array(value, dtype=np.float32)
