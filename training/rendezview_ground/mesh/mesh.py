"""The CAD model as one clean triangle mesh in metres."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.target import METRES_PER_UNIT, split_node
from rendezview_ground.mesh.bounding_sphere import smallest_enclosing_sphere
from rendezview_ground.mesh.colours import GREY, Rgb
from rendezview_ground.mesh.files import READERS, read_mesh_file
from rendezview_ground.mesh.mesh_file import MeshFile
from rendezview_ground.mesh.notes import counted, topology_notes
from rendezview_ground.mesh.plausible import metres_per_unit
from rendezview_ground.mesh.triangles import twice_areas

MAX_FACES = 20_000_000  # of a mesh
MAX_FILE_BYTES = 2 * 2**30  # bytes of a mesh file

_GREY_FROM_RGB = np.array([0.2126, 0.7152, 0.0722])  # luminance weights. Source: ITU-R BT.709
_LARGEST_COORDINATE = 1e15  # in the unit of the file; its powers still fit a double
# What turns other formats into one that is read. Units and axes of FBX, 3DS and VRML are not in
# their numbers: a program that shows the model applies them.
_CAD = "export it from the CAD program as STEP or STL"
_SCENE = "import it in Blender, check its size and axes, and export it as glTF (GLB)"
_ADVICE = {
    **dict.fromkeys(
        (".iges", ".igs", ".sldprt", ".sldasm", ".ipt", ".iam", ".catpart", ".catproduct", ".prt",
         ".asm", ".x_t", ".x_b", ".sat", ".3dm", ".fcstd", ".f3d", ".jt", ".dwg", ".dxf"),
        _CAD,
    ),
    **dict.fromkeys(
        (".blend", ".fbx", ".3ds", ".wrl", ".vrml", ".x3d", ".x3dv", ".max", ".ma", ".mb", ".c4d",
         ".lwo", ".lws", ".ase", ".x", ".md2", ".md3", ".abc", ".skp", ".b3d", ".ac"),
        _SCENE,
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh in the target frame, metres.

    Colours are linear albedo. Winding is as in the file and may be mixed.
    """

    vertices_m: Array  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    face_rgb: NDArray[np.float32]  # (F, 3) in [0, 1]; 0.6 grey without a colour in the file
    notes: tuple[str, ...]  # one sentence for everything found, guessed or ignored
    # (F,) 0: the body, k: the parts of hinge k − 1; None: nothing turns
    face_part: NDArray[np.uint8] | None = None
    # (F,) how far the craft is as the mesh has it, 0 to 1; None: all of it
    face_trust: NDArray[np.float32] | None = None
    doubts: tuple[str, ...] = ()  # those of the notes that ask whether the mesh is meant so

    def with_faces(
        self, vertices_m: Array, faces: NDArray[np.integer], source: NDArray[np.integer]
    ) -> Mesh:
        """Other vertices and faces (F, 3), each with what this mesh says of its face ``source``."""
        return replace(
            self,
            vertices_m=np.ascontiguousarray(vertices_m),
            faces=np.ascontiguousarray(faces, dtype=np.int32),
            face_rgb=np.ascontiguousarray(self.face_rgb[source]),
            face_part=None if self.face_part is None else self.face_part[source],
            face_trust=None if self.face_trust is None else self.face_trust[source],
        )

    @property
    def bounding_sphere(self) -> tuple[Array, float]:
        """Centre (3,) and radius in metres of the smallest sphere around all faces."""
        return smallest_enclosing_sphere(self.vertices_m[np.unique(self.faces)])

    @property
    def face_albedo(self) -> Array:
        """(F,) albedo of the colours as a grey camera sees them (Rec. 709 luminance)."""
        grey: Array = np.asarray(self.face_rgb, dtype=np.float64) @ _GREY_FROM_RGB
        return grey

    @property
    def extent_m(self) -> Array:
        """Size (3,) of the faces along the axes."""
        extent: Array = np.ptp(self.vertices_m[np.unique(self.faces)], axis=0)
        return extent


def load_mesh(path: Path, unit: str | None = None) -> Mesh:
    """Read a mesh file as one clean mesh in metres, with all its bodies.

    Args:
        path: STL, OBJ, PLY, OFF, GLB, glTF, 3MF, DAE, STEP or USD file; ``FILE#NODE`` for one
            node of a scene, with what hangs below it.
        unit: of the file's numbers; overrides the file. Without it, 3MF, DAE, glTF and USD files
            state their unit; the others are read as metres if the size is then plausible.

    Raises:
        RendezviewError: the file is missing, unreadable, without triangles or too large, or its
            unit is needed.
    """
    path, node = split_node(Path(path))
    if unit is not None and unit not in METRES_PER_UNIT:
        raise RendezviewError(f"unknown unit {unit!r}: use one of {', '.join(METRES_PER_UNIT)}")
    _check_file(path)
    _check_count(path, _announced_faces(path))
    content = read_mesh_file(path, node)
    _check_count(path, len(content.faces))
    vertices, faces, rgb, notes = _cleaned(path, content)
    factor, unit_note, doubts = metres_per_unit(path, vertices, content, unit)
    kind = path.suffix[1:].upper()
    found = (
        f"{kind} file with {counted(len(faces), 'triangle')} "
        f"and {counted(len(vertices), 'vertex')}."
    )
    return Mesh(
        vertices_m=vertices * factor,
        faces=faces.astype(np.int32),
        face_rgb=np.ascontiguousarray(np.clip(rgb, 0.0, 1.0), dtype=np.float32),
        notes=(found, unit_note, *doubts, *content.notes, *notes, *topology_notes(faces)),
        doubts=doubts,
    )


def _check_file(path: Path) -> None:
    if not path.exists():
        raise RendezviewError(f"mesh file {path} does not exist: check the path")
    if path.is_dir():
        raise RendezviewError(f"{path} is a folder: name the mesh file in it")
    suffix = path.suffix.lower()
    if suffix not in READERS:
        known = ", ".join(READERS)
        advice = _ADVICE.get(suffix, "export the model as one of them")
        raise RendezviewError(
            f"{path}: mesh format {suffix or 'without a suffix'} is not supported ({known} are): "
            f"{advice}"
        )
    size = path.stat().st_size
    if size == 0:
        raise RendezviewError(f"mesh file {path} is empty: export it again")
    if size > MAX_FILE_BYTES:
        raise RendezviewError(
            f"mesh file {path} has {size / 2**30:.1f} GiB, more than can be used: "
            "simplify the model (100,000 triangles are plenty) and export it again"
        )


def _announced_faces(path: Path) -> int:
    """Number of triangles that the start of the file announces, or 0."""
    try:
        with path.open("rb") as stream:
            start = stream.read(4096)
    except OSError as error:
        raise RendezviewError(f"mesh file {path} cannot be opened: {error.strerror}") from error
    if path.suffix.lower() == ".ply":
        match = re.search(rb"element face (\d{1,18})", start)
        return int(match.group(1)) if match else 0
    if path.suffix.lower() == ".stl" and len(start) >= 84:
        count = int.from_bytes(start[80:84], "little")
        return count if path.stat().st_size == 84 + 50 * count else 0
    return 0


def _check_count(path: Path, count: int) -> None:
    if count > MAX_FACES:
        raise RendezviewError(
            f"{path} has {count} triangles, more than the {MAX_FACES} that can be used: "
            "simplify the model (100,000 are plenty) and export it again"
        )


def _cleaned(
    path: Path, content: MeshFile
) -> tuple[Array, NDArray[np.int64], Rgb, tuple[str, ...]]:
    """Drop faces without area or position, merge equal vertices, drop unused ones."""
    faces, rgb = content.faces, content.face_rgb
    if len(faces) == 0:
        what = " (a cloud of points?)" if len(content.vertices) else ""
        raise RendezviewError(
            f"{path} holds no triangles{what}. "
            "Export the model as a surface mesh; check that the file matches its suffix."
        )
    finite = (np.abs(content.vertices[faces]) < _LARGEST_COORDINATE).all(axis=(1, 2))
    if not finite.any():
        raise RendezviewError(
            f"{path}: every face has a coordinate that is not a usable number; "
            "export the mesh again"
        )
    faces, rgb = faces[finite], rgb[finite]
    unique, faces = _merged(content.vertices, faces)
    solid = twice_areas(unique[faces]) > 1e-14 * float(np.linalg.norm(np.ptp(unique, axis=0))) ** 2
    if not solid.any():
        raise RendezviewError(
            f"{path}: none of its {len(faces)} faces has an area; export the mesh again"
        )
    vertices, kept = _merged(unique, faces[solid])
    dropped = (
        (int((~finite).sum()), "with a coordinate that is not a usable number"),
        (int((~solid).sum()), "without area"),
    )
    notes = [f"{counted(count, 'face')} {what} dropped." for count, what in dropped if count]
    if np.allclose(rgb[solid], GREY) and not any("grey" in note for note in content.notes):
        notes.append("No usable colours: faces are grey.")
    return vertices, kept, rgb[solid], tuple(notes)


def _merged(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Used vertices, each position once, in the order of the file."""
    used = np.unique(faces)
    number = np.zeros(len(vertices), dtype=np.int64)
    positions = vertices[used] + 0.0  # makes −0.0 equal to 0.0
    _, first, inverse = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    number[used] = rank[inverse.reshape(-1)]
    return positions[first[order]], number[faces]
