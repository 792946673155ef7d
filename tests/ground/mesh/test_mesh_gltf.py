"""glTF files that cannot be read are refused in words that say why."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest
import trimesh

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.mesh import load_mesh


def _gltf(folder: Path, change: dict[str, Any]) -> Path:
    """A box as glTF with its buffers beside it, some entries of its header changed."""
    path = folder / "craft.gltf"
    for name, data in trimesh.creation.box().export(file_type="gltf").items():
        (folder / name).write_bytes(data)
    header = json.loads((folder / "model.gltf").read_text())
    path.write_text(json.dumps(header | change))
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"asset": {"version": "1.0"}}, "export it as glTF 2.0"),
        ({"buffers": [{"uri": "body%201.bin", "byteLength": 4}]}, "body 1.bin, which is not there"),
        ({"buffers": [{"uri": "../body.bin", "byteLength": 4}]}, "outside the folder of the mesh"),
    ],
)
def test_a_gltf_file_that_cannot_be_read_says_why(
    tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    with pytest.raises(RendezviewError, match=words):
        load_mesh(_gltf(tmp_path, change), None)


def test_a_binary_file_of_the_first_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.glb"
    path.write_bytes(struct.pack("<4sIIII", b"glTF", 1, 20, 0, 0))
    with pytest.raises(RendezviewError, match=r"glTF 1\.0"):
        load_mesh(path, None)


@pytest.mark.parametrize("data", [b"glTF", b"[]", b"{}", b'{"buffers": 3, "meshes": [4]}'])
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_a_damaged_header_is_a_damaged_file(tmp_path: Path, suffix: str, data: bytes) -> None:
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(data)
    with pytest.raises(RendezviewError, match="bad"):
        load_mesh(path, None)
