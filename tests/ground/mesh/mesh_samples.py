"""Small mesh files that the tests of the readers share."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from rendezview.io.target import Target
from rendezview_ground.mesh.mesh import Mesh, load_mesh

Triple = tuple[float, float, float]
EXTENT_M = np.array([2.0, 1.0, 0.5])
FORMATS = ["stl", "obj", "ply", "glb", "gltf", "3mf", "dae"]
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
# A body, a mast and a wing: the wing alone lies in the box.
_BODY = [((2.0, 1.2, 0.8), (0.0, 0.0, 0.0)), ((0.5, 0.5, 0.9), (0.9, 0.3, 0.5))]
_WING = ((1.2, 1.4, 0.05), (0.1, 1.5, 0.0))
HINGE_M = [0.1, 0.8, 0.0]  # where the wing joins the body
WING_BOXES_M = "[[[-1.0, 0.7, -1.0], [1.0, 3.0, 1.0]]]"


def box(scale: float = 1.0) -> trimesh.Trimesh:
    made = trimesh.creation.box(EXTENT_M * scale)
    made.apply_translation(np.array([3.0, -1.0, 0.25]) * scale)
    return made


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def export(folder: Path, suffix: str, scene: object, **options: object) -> Path:
    made = scene.export(file_type=suffix, **options)  # type: ignore[attr-defined]
    if isinstance(made, dict):  # glTF: several files
        for name, content in made.items():
            write(folder / name, content)
        return next(folder.glob("*.gltf"))
    return write(folder / f"mesh.{suffix}", made)


def boxes(sizes_and_places_m: Iterable[tuple[Triple, Triple]]) -> list[trimesh.Trimesh]:
    """Boxes of some sizes at some places."""
    made = []
    for size_m, place_m in sizes_and_places_m:
        made.append(trimesh.creation.box(size_m))
        made[-1].apply_translation(place_m)
    return made


def grey_mesh(bodies: list[trimesh.Trimesh]) -> Mesh:
    """All bodies as one mesh of one grey."""
    whole = trimesh.util.concatenate(bodies)
    assert isinstance(whole, trimesh.Trimesh)
    faces = np.array(whole.faces, dtype=np.int32)
    return Mesh(np.array(whole.vertices), faces, np.full((len(faces), 3), 0.6, np.float32), ())


def winged_mesh(wing_turn_rad: float = 0.0) -> trimesh.Trimesh:
    """Body and wing, the wing turned about its hinge, which is parallel to x."""
    made = boxes((*_BODY, _WING))
    made[-1].apply_transform(
        trimesh.transformations.rotation_matrix(wing_turn_rad, [1.0, 0.0, 0.0], HINGE_M)
    )
    return trimesh.util.concatenate(made)


def winged_target(folder: Path, parts: str) -> Target:
    """A target file with that mesh and the lines that say what the wing is."""
    folder.mkdir(exist_ok=True)
    winged_mesh().export(folder / "winged.obj")
    text = f'name = "winged"\n[mesh]\npath = "winged.obj"\nunit = "m"\n{parts}'
    (folder / "target.toml").write_text(text, encoding="utf-8")
    return Target.load(folder)


def triangles(mesh: Mesh) -> np.ndarray:
    """Triangles in an order that does not depend on the file's."""
    corner = mesh.vertices_m[mesh.faces].round(6) + 0.0
    rolled = [np.roll(t, -int(np.lexsort(t.T[::-1])[0]), axis=0).ravel() for t in corner]
    return np.array(sorted(map(tuple, rolled)))


def note_with(mesh: Mesh, words: str) -> str:
    found = [note for note in mesh.notes if words in note]
    assert len(found) == 1, mesh.notes
    return found[0]


def three_mf(path: Path, unit: str | None, scale: float) -> Path:
    """A tetrahedron with two base-material faces, one colour-group face and a plain one."""
    said = f' unit="{unit}"' if unit else ""
    corners = "".join(
        f'<vertex x="{x * scale}" y="{y * scale}" z="{z * scale}"/>'
        for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    model = (
        f'<?xml version="1.0"?><model{said} '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02" '
        'xmlns:m="http://schemas.microsoft.com/3dmanufacturing/material/2015/02"><resources>'
        '<basematerials id="5"><base name="gold" displaycolor="#FF8000"/>'
        '<base name="black" displaycolor="#000000FF"/></basematerials>'
        '<m:colorgroup id="6"><m:color color="#0000FF"/></m:colorgroup>'
        '<object id="1" type="model" pid="5" pindex="0"><mesh>'
        f"<vertices>{corners}</vertices><triangles>"
        '<triangle v1="0" v2="2" v3="1"/><triangle v1="0" v2="1" v3="3" pid="5" p1="1"/>'
        '<triangle v1="1" v2="2" v3="3" pid="6" p1="0"/>'
        '<triangle v1="0" v2="3" v3="2" pid="99" p1="0"/>'
        '</triangles></mesh></object></resources><build><item objectid="1" '
        f'transform="1 0 0 0 1 0 0 0 1 {5 * scale} 0 0"/></build></model>'
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", model)
    return path


def obj(folder: Path, text: str) -> Mesh:
    return load_mesh(write(folder / "a.obj", text))


def checker(path: Path) -> Image.Image:
    """Left half red, right half blue."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4, 0] = 255
    pixels[:, 4:, 2] = 255
    image = Image.fromarray(pixels)
    image.save(path)
    return image
