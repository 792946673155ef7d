"""Writes a built vehicle: GLB scene, binary STL, target.toml and picture.

All in the vehicle's target frame, metres; no rotation to glTF's Y-up. The same parts
give the same bytes: vertices are rounded to a micrometre, which swallows the last-bit
differences of sine and cosine between processors.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from models_cad.parts import Array, Colour, Part, Vector, joined
from models_cad.picture import View, render


def checked(parts: Sequence[Part]) -> list[Part]:
    """The parts with rounded vertices.

    Raises:
        ValueError: a name is used twice, or a part is not a closed solid.
    """
    names = [part.name for part in parts]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"part names are used twice: {', '.join(repeated)}")
    rounded = []
    for part in parts:
        vertices = np.round(part.mesh.vertices, 6) + 0.0  # + 0.0 turns −0 into 0
        mesh = trimesh.Trimesh(vertices, part.mesh.faces, process=False)
        if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0):
            raise ValueError(f"part {part.name!r} is not a closed solid of positive volume")
        rounded.append(Part(part.name, mesh, part.colour))
    return rounded


def _material(colour: Colour) -> trimesh.visual.material.PBRMaterial:
    """The glTF material; glTF wants linear light where `Colour` is sRGB."""
    srgb = np.array(colour.srgb) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return trimesh.visual.material.PBRMaterial(
        name=colour.name,
        baseColorFactor=[*np.round(255.0 * linear).astype(np.uint8).tolist(), 255],
        metallicFactor=colour.metallic,
        roughnessFactor=colour.roughness,
    )


def glb_bytes(parts: Sequence[Part]) -> bytes:
    """Binary glTF: one named node, mesh and material reference a part."""
    scene = trimesh.Scene(base_frame="target")
    materials = {part.colour.name: _material(part.colour) for part in parts}
    for part in parts:
        mesh = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(material=materials[part.colour.name])
        scene.add_geometry(mesh, node_name=part.name, geom_name=part.name)
    return bytes(scene.export(file_type="glb", include_normals=False))


def stl_bytes(parts: Sequence[Part]) -> bytes:
    """Binary STL of all parts, one after the other."""
    whole = joined(*(part.mesh for part in parts))
    return bytes(trimesh.exchange.stl.export_stl(whole))


def numbers(vector: Vector) -> str:
    """A vector as a TOML array, rounded to a micrometre."""
    values: Array = np.round(np.asarray(vector, float), 6) + 0.0
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def feature(table: str, **entries: str | float | Vector) -> str:
    """One table of target.toml, such as `[[leds]]`, with its keys in the order given."""
    lines = [table]
    for key, value in entries.items():
        if isinstance(value, str):
            lines.append(f'{key} = "{value}"')
        elif isinstance(value, float):
            lines.append(f"{key} = {value!r}")
        else:
            lines.append(f"{key} = {numbers(value)}")
    return "\n".join(lines) + "\n"


def target_text(name: str, description: str, frame: str, features: Sequence[str] = ()) -> str:
    """The whole target.toml: `frame` becomes the comment at its top."""
    comment = "".join(f"# {line}".rstrip() + "\n" for line in frame.strip().splitlines())
    head = f'{comment}name = "{name}"\ndescription = "{description}"\n'
    mesh = feature("[mesh]", path=f"{name}.glb", unit="m")
    return "\n".join([head, mesh, *features])


def main(name: str, parts: Sequence[Part], target: str, view: View, folder: Path) -> None:
    """The builder's command: write everything into `folder` or the folder given."""
    parser = argparse.ArgumentParser(description=f"Build the target vehicle {name!r}.")
    parser.add_argument("folder", nargs="?", type=Path, default=folder, help="where to write")
    parser.add_argument("--no-picture", action="store_true", help="leave the picture out")
    arguments = parser.parse_args()
    solids = checked(parts)
    out: Path = arguments.folder
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.glb").write_bytes(glb_bytes(solids))
    (out / f"{name}.stl").write_bytes(stl_bytes(solids))
    (out / "target.toml").write_text(target, encoding="utf-8", newline="\n")
    if not arguments.no_picture:
        render(solids, view).save(out / f"{name}.png", optimize=True)
    whole = joined(*(part.mesh for part in solids))
    size = " × ".join(f"{extent:.2f}" for extent in whole.extents)
    print(f"{name}: {len(solids)} parts, {len(whole.faces)} triangles, {size} m")
