"""Features of glTF that change the shape or its colour are honoured, or refused by their name."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import DracoPy
import meshoptimizer
import numpy as np
import pytest
from tests.ground.mesh.gltf_samples import CORNERS, FACES, Glb
from tests.ground.mesh.mesh_samples import note_with, triangles

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.mesh import Mesh, load_mesh

RED, GREEN, BLUE = np.eye(3)


@pytest.fixture
def glb() -> Glb:
    return Glb()


def read(made: Glb, folder: Path) -> Mesh:
    return load_mesh(made.write(folder / "a.glb"))


@pytest.fixture
def plain(tmp_path: Path) -> Mesh:
    made = Glb()
    made.primitive(made.accessor(CORNERS))
    return read(made, tmp_path)


def sparse(made: Glb, rows: list[int], values: np.ndarray, kind: str) -> dict[str, Any]:
    where = np.array(rows, kind)
    return {
        "sparse": {
            "count": len(rows),
            "indices": {"bufferView": made.view(where.tobytes()), "componentType": 5121
                        if kind == "u1" else 5123},
            "values": {"bufferView": made.view(values.tobytes())},
        }
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize("stored", [False, True])
def test_sparse_positions_are_those_of_the_sparse_part(
    glb: Glb, plain: Mesh, tmp_path: Path, kind: str, stored: bool
) -> None:
    rows = [1, 2, 5] if stored else list(range(6))
    base = CORNERS + np.isin(np.arange(6), rows)[:, None].astype(np.float32)
    more = sparse(glb, rows, CORNERS[rows], kind)
    glb.primitive(glb.accessor(base, -1 if stored else None, **more))
    np.testing.assert_array_equal(triangles(read(glb, tmp_path)), triangles(plain))


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2"])
@pytest.mark.parametrize("stride", [0, 12])
def test_quantised_positions_are_fractions(
    glb: Glb, plain: Mesh, tmp_path: Path, kind: str, stride: int
) -> None:
    size = np.array([2.0, 4.0, 1.0])
    low = -1.0 if kind[0] == "i" else 0.0
    wanted = low + (CORNERS - CORNERS.min(axis=0)) / size * (1.0 - low)
    whole = np.round(wanted * np.iinfo(kind).max).astype(kind)
    view = -1
    if stride:
        rows = np.zeros((6, stride), np.uint8)
        rows[:, : 3 * whole.itemsize] = whole.view(np.uint8)
        view = glb.view(rows.tobytes(), byteStride=stride)
    glb.primitive(glb.accessor(whole, view, normalized=True))
    scale = size / (1.0 - low)
    place = CORNERS.min(axis=0) - low * scale
    glb.header["nodes"][0] |= {"scale": scale.tolist(), "translation": place.tolist()}
    glb.header |= {"extensionsRequired": ["KHR_mesh_quantization"]}
    mesh = read(glb, tmp_path)
    np.testing.assert_allclose(mesh.extent_m, [2.0, 4.0, 1.0], rtol=1e-5)
    np.testing.assert_allclose(
        np.sort(mesh.vertices_m, axis=0), np.sort(plain.vertices_m, axis=0), atol=1e-5
    )


def test_whole_numbers_that_are_no_fractions_stay_whole(glb: Glb, tmp_path: Path) -> None:
    glb.primitive(glb.accessor((10 * CORNERS).astype("i2")))
    glb.header["nodes"][0]["scale"] = [0.1, 0.1, 0.1]
    np.testing.assert_allclose(read(glb, tmp_path).extent_m, [2.0, 4.0, 1.0])


@pytest.mark.parametrize("indexed", [False, True])
def test_a_fan_becomes_triangles(glb: Glb, tmp_path: Path, indexed: bool) -> None:
    ring = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5], [-1, 0.5, 1]], np.float32)
    made = glb.primitive(glb.accessor(ring), mode=6)
    if indexed:
        made["indices"] = glb.accessor(np.arange(5, dtype="u1"))
        glb.header["meshes"][0]["primitives"] = [made]
    else:
        del glb.header["meshes"][0]["primitives"][0]["indices"]
    mesh = read(glb, tmp_path)
    assert sorted(map(sorted, mesh.faces.tolist())) == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


def test_a_primitive_without_positions_is_left_out_with_a_note(
    glb: Glb, plain: Mesh, tmp_path: Path
) -> None:
    glb.primitive(glb.accessor(CORNERS))
    glb.primitive(None)
    glb.header["meshes"].append({"primitives": [{"attributes": {}}]})
    glb.header["nodes"].append({"mesh": 1})
    glb.header["scenes"][0]["nodes"].append(1)
    mesh = read(glb, tmp_path)
    np.testing.assert_array_equal(triangles(mesh), triangles(plain))
    assert note_with(mesh, "2 primitives without positions")


@pytest.mark.parametrize("kind", ["f4", "i1", "i2"])
def test_every_instance_of_a_node_is_drawn(glb: Glb, tmp_path: Path, kind: str) -> None:
    glb.primitive(glb.accessor(CORNERS))
    places = np.array([[0, 0, 0], [0, 0, 5], [8, 0, 0]], np.float32)
    turns = np.array([[0, 0, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0]])
    fractions = kind != "f4"
    turned = (turns * (np.iinfo(kind).max if fractions else 1)).astype(kind)
    attributes = {
        "TRANSLATION": glb.accessor(places),
        "ROTATION": glb.accessor(turned, normalized=fractions),
        "SCALE": glb.accessor(np.array([[1, 1, 1], [2, 2, 2], [1, 1, 1]], np.float32)),
    }
    name = "EXT_mesh_gpu_instancing"
    glb.header["nodes"][0] |= {
        "extensions": {name: {"attributes": attributes}}, "translation": [0.0, 0.0, 1.0],
    }  # fmt: skip
    glb.header["extensionsRequired"] = [name]
    mesh = read(glb, tmp_path)
    assert len(mesh.faces) == 3 * len(FACES)
    np.testing.assert_allclose(mesh.vertices_m.min(axis=0), [-2.0, -4.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices_m.max(axis=0), [9.0, 4.0, 6.0], atol=1e-6)
    assert note_with(mesh, "3 instances")


TRANSFORM = "KHR_texture_transform"


@pytest.mark.parametrize(
    ("change", "colour"),
    [
        ({}, RED),
        ({"offset": [0.5, 0.0]}, GREEN),
        ({"offset": [0.0, 0.5]}, BLUE),
        ({"scale": [3.0, 1.0]}, GREEN),
        ({"scale": [1.0, 3.0]}, BLUE),
        ({"offset": [1.0, 0.0], "rotation": -0.5 * math.pi}, GREEN),
        # The example of the extension: the lower left quarter.
        ({"offset": [0.0, 1.0], "rotation": 0.5 * math.pi, "scale": [0.5, 0.5]}, BLUE),
        ({"texCoord": 1}, GREEN),
        ({"texCoord": 1, "offset": [-0.5, 0.0]}, RED),
        (None, GREEN),
    ],
)  # fmt: skip
@pytest.mark.parametrize("required", [False, True])
def test_the_texture_is_where_its_transform_puts_it(
    glb: Glb, tmp_path: Path, change: dict[str, Any] | None, colour: np.ndarray, required: bool
) -> None:
    texture = glb.texture(**({"texCoord": 1} if change is None else {}))
    if change is not None:
        texture["extensions"] = {TRANSFORM: change}
    if required:
        glb.header["extensionsRequired"] = [TRANSFORM]
    made = glb.primitive(glb.accessor(CORNERS), material=0)
    first = np.tile(np.array([[0.25, 0.2]], np.float32), (6, 1))
    second = np.tile(np.array([[0.75, 0.2]], np.float32), (6, 1))
    made["attributes"] |= {"TEXCOORD_0": glb.accessor(first), "TEXCOORD_1": glb.accessor(second)}
    glb.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": texture}}]
    np.testing.assert_allclose(read(glb, tmp_path).face_rgb, np.tile(colour, (8, 1)), atol=1e-6)


@pytest.mark.parametrize("textured", [False, True])
def test_the_diffuse_colour_of_a_glossy_material_is_its_colour(
    glb: Glb, tmp_path: Path, textured: bool
) -> None:
    gloss: dict[str, Any] = {"diffuseFactor": [0.0, 0.0, 1.0, 1.0]}
    made = glb.primitive(glb.accessor(CORNERS), material=0)
    if textured:
        gloss = {"diffuseTexture": glb.texture()}
        uv = np.tile(np.array([[0.75, 0.2]], np.float32), (6, 1))
        made["attributes"]["TEXCOORD_0"] = glb.accessor(uv)
    name = "KHR_materials_pbrSpecularGlossiness"
    glb.header["materials"] = [{"extensions": {name: gloss}}]
    expected = GREEN if textured else BLUE
    np.testing.assert_allclose(read(glb, tmp_path).face_rgb, np.tile(expected, (8, 1)), atol=1e-6)


@pytest.mark.parametrize(
    "name", ["MSFT_lod", "KHR_node_visibility", "EXT_structural_metadata", "CESIUM_primitive"]
)
def test_a_required_extension_that_is_not_honoured_is_refused_by_its_name(
    glb: Glb, tmp_path: Path, name: str
) -> None:
    glb.primitive(glb.accessor(CORNERS))
    glb.header["extensionsUsed"] = [name]
    assert len(read(glb, tmp_path).faces) == 8
    glb.header["extensionsRequired"] = [name, "KHR_materials_unlit"]
    with pytest.raises(RendezviewError, match=f"it requires {name}, which is not honoured"):
        read(glb, tmp_path)


def with_draco(glb: Glb) -> Glb:
    name = "KHR_draco_mesh_compression"
    content = DracoPy.encode(CORNERS, faces=FACES.astype(np.uint32), quantization_bits=16)
    made = glb.primitive(glb.accessor(CORNERS, None))
    made["extensions"] = {name: {"bufferView": glb.view(content), "attributes": {"POSITION": 0}}}
    made["indices"] = glb.accessor(FACES.reshape(-1), None)
    glb.header["meshes"][0]["primitives"] = [made]
    glb.header["extensionsRequired"] = [name]
    return glb


def with_meshopt(glb: Glb, filtered: bool) -> Glb:
    name = "EXT_meshopt_compression"
    stored = CORNERS.astype("<f4")
    if filtered:  # 24 bits and a power of two
        stored = ((np.round(CORNERS * 256).astype("<i4") & 0xFFFFFF) | (-8 << 24)).astype("<i4")
    packed = meshoptimizer.encode_vertex_buffer(stored.view("<f4"), 6, 12)
    order = meshoptimizer.encode_index_buffer(FACES.reshape(-1).astype(np.uint32), 24, 6)
    views = []
    for content, length, more in (
        (packed, 72, {"byteStride": 12, "count": 6, "mode": "ATTRIBUTES"}),
        (order, 48, {"byteStride": 2, "count": 24, "mode": "TRIANGLES"}),
    ):
        inside = glb.view(bytes(content))
        entry = glb.header["bufferViews"].pop()
        if filtered and more["mode"] == "ATTRIBUTES":
            more["filter"] = "EXPONENTIAL"
        glb.header["bufferViews"].append(
            {"buffer": 1, "byteLength": length, "extensions": {name: entry | more}}
        )
        views.append(inside)
    made = glb.primitive(glb.accessor(CORNERS, views[0]))
    made["indices"] = glb.accessor(FACES.reshape(-1), views[1])
    glb.header["meshes"][0]["primitives"] = [made]
    glb.header["extensionsRequired"] = [name]
    return glb


def packed(kind: str) -> Glb:
    made = Glb()
    return with_draco(made) if kind == "draco" else with_meshopt(made, kind == "filtered")


@pytest.mark.parametrize("kind", ["draco", "meshopt", "filtered"])
def test_packed_geometry_is_unpacked(plain: Mesh, tmp_path: Path, kind: str) -> None:
    mesh = read(packed(kind), tmp_path)
    np.testing.assert_allclose(triangles(mesh), triangles(plain), atol=1e-3)


@pytest.mark.parametrize(
    ("kind", "package", "extension"),
    [("draco", "DracoPy", "KHR_draco_mesh"), ("meshopt", "meshoptimizer", "EXT_meshopt")],
)
def test_packed_geometry_names_the_package_that_unpacks_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, package: str, extension: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RendezviewError, match=rf"{extension}.* needs {package}: .*, or export"):
        read(packed(kind), tmp_path)
