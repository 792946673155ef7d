"""Poses by the edges of a model, with ViSP's generic tracker, on single pictures.

ViSP comes with Debian (``libvisp-dev``); its program is compiled on the spot.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import trimesh

from rendezview import Camera, Pose
from rendezview_ground.mesh.mesh import Mesh

SOURCE = Path(__file__).with_suffix(".cpp")
_FLAT_RAD = 0.01  # between the normals of one flat face. Source: by construction


def poses(
    mesh: Mesh, camera: Camera, starts: Sequence[tuple[np.ndarray, Pose]]
) -> list[Pose | None] | None:
    """The pose of each picture from its start, None where it is lost; None: no ViSP here."""
    known = shutil.which("pkg-config") and subprocess.run(["pkg-config", "--exists", "visp"])
    if not known or known.returncode or shutil.which("c++") is None:
        return None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, model = folder / "visp_edges", folder / "model.cao"
        flags = _said("pkg-config", "--cflags", "--libs", "visp").split()
        _said("c++", "-O1", "-o", str(program), str(SOURCE), *flags)
        model.write_text(cao_of(mesh))
        lines = []
        for k, (picture, pose) in enumerate(starts):
            path = folder / f"{k}.png"
            cv2.imwrite(str(path), picture)
            numbers = np.hstack([pose.rotation, pose.translation_m[:, None]]).ravel()
            lines.append(" ".join([str(path), *(f"{number:.12g}" for number in numbers)]))
        lens = [str(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy)]
        said = _said(str(program), str(model), *lens, given="\n".join(lines))
    return [_pose(line) for line in said.splitlines() if line == "lost" or len(line.split()) == 12]


def cao_of(mesh: Mesh) -> str:
    """The outlines of a mesh's flat faces in ViSP's CAO format."""
    places, which = np.unique(np.round(mesh.vertices_m, 9), axis=0, return_inverse=True)
    faces = which.reshape(-1)[mesh.faces]
    body = trimesh.Trimesh(places, faces, process=False)
    side_by_side = body.face_adjacency[body.face_adjacency_angles < _FLAT_RAD]
    flat = trimesh.graph.connected_components(side_by_side, nodes=np.arange(len(faces)))
    outlines = [loop for group in flat for loop in _loops(faces[group])]
    lines = ["V1", str(len(places)), *(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in places)]
    lines += ["0", "0", str(len(outlines))]  # no lines; faces by lines; faces by points
    lines += [f"{len(loop)} {' '.join(map(str, loop))}" for loop in outlines]
    return "\n".join([*lines, "0", "0", ""])


def _loops(faces: np.ndarray) -> list[list[int]]:
    """The closed borders of some triangles, in their sense."""
    edges = [(int(face[i - 1]), int(face[i])) for face in faces for i in range(3)]
    after = {a: b for a, b in edges if (b, a) not in edges}
    loops = []
    while after:
        first, at = after.popitem()
        loop = [first]
        while at != first and at in after:
            loop.append(at)
            at = after.pop(at)
        loops += [loop] if len(loop) > 2 else []
    return loops


def _said(*command: str, given: str | None = None) -> str:
    return subprocess.run(
        command, input=given, check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def _pose(line: str) -> Pose | None:
    if line == "lost":
        return None
    matrix = np.array(line.split(), dtype=np.float64).reshape(3, 4)
    left, _, right = np.linalg.svd(matrix[:, :3])
    return Pose(left @ right, matrix[:, 3])
