"""Facts about the bundled target vehicles: published sizes, closed solids, same bytes.

Sources of the figures are named in each vehicle's `build.py`. Metres, target frame.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from tests.waiting import MOST_S

from rendezview.io.target import Target
from rendezview_ground.mesh.joints import posed, with_parts
from rendezview_ground.mesh.mesh import load_mesh

MODELS = Path(__file__).resolve().parents[2] / "models_cad"
VEHICLES = ("hubble", "client", "scole", "shuttle")
INCH = 0.0254
KEYS = {
    "mesh": {"path", "unit"},
    "docking_ring": {"centre_m", "axis", "radius_m"},
    "reflectors": {"name", "group", "position_m", "normal", "diameter_m"},
    "leds": {"name", "position_m", "normal"},
}


@cache
def scene(vehicle: str) -> trimesh.Scene:
    return trimesh.load_scene(MODELS / vehicle / f"{vehicle}.glb")


@cache
def target(vehicle: str) -> dict[str, Any]:
    return tomllib.loads((MODELS / vehicle / "target.toml").read_text(encoding="utf-8"))


def part(vehicle: str, name: str) -> trimesh.Trimesh:
    return scene(vehicle).geometry[name]


def parts_like(vehicle: str, start: str, end: str = "") -> trimesh.Trimesh:
    chosen = [
        mesh
        for name, mesh in sorted(scene(vehicle).geometry.items())
        if name.startswith(start) and name.endswith(end)
    ]
    assert chosen, f"no part of {vehicle} is called {start}…{end}"
    return trimesh.Trimesh(
        np.vstack([mesh.vertices for mesh in chosen]),
        np.vstack(
            [
                mesh.faces + sum(len(other.vertices) for other in chosen[:k])
                for k, mesh in enumerate(chosen)
            ]
        ),
        process=False,
    )


def distance(mesh: trimesh.Trimesh, points: Any) -> np.ndarray:
    """Distance from each of `points` (N, 3) to the surface, without a spatial index."""
    points = np.atleast_2d(np.asarray(points, float))
    closest = [
        trimesh.triangles.closest_point(mesh.triangles, np.repeat(point[None], len(mesh.faces), 0))
        for point in points
    ]
    return np.array(
        [
            np.linalg.norm(near - point, axis=1).min()
            for near, point in zip(closest, points, strict=True)
        ]
    )


def is_hidden(mesh: trimesh.Trimesh, start: np.ndarray, direction: np.ndarray) -> bool:
    """Whether the ray meets any triangle (Möller and Trumbore, 1997)."""
    a, b, c = mesh.triangles.transpose(1, 0, 2)
    p = np.cross(direction, c - a)
    determinant = np.einsum("nk,nk->n", b - a, p)
    crossed = np.abs(determinant) > 1e-12
    scale = 1.0 / np.where(crossed, determinant, 1.0)
    u = np.einsum("nk,nk->n", start - a, p) * scale
    q = np.cross(start - a, b - a)
    v = q @ direction * scale
    along = np.einsum("nk,nk->n", c - a, q) * scale
    return bool((crossed & (u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0)).any())


def edge_counts(mesh: trimesh.Trimesh) -> np.ndarray:
    return np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_every_part_of_the_glb_is_a_closed_coloured_solid(vehicle: str) -> None:
    for name, mesh in scene(vehicle).geometry.items():
        assert mesh.is_watertight, name
        assert mesh.is_winding_consistent, name
        assert mesh.volume > 0.0, name
        material = mesh.visual.material
        assert material.baseColorFactor is not None, name
        assert material.baseColorFactor[3] == 255, name


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_no_transform_in_the_glb_moves_the_target_frame(vehicle: str) -> None:
    for node in scene(vehicle).graph.nodes_geometry:
        np.testing.assert_array_equal(scene(vehicle).graph[node][0], np.eye(4))


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_stl_and_glb_hold_the_same_triangles(vehicle: str) -> None:
    stl = trimesh.load_mesh(MODELS / vehicle / f"{vehicle}.stl")
    assert 3_000 <= len(stl.faces) <= 20_000
    assert len(stl.faces) == sum(len(mesh.faces) for mesh in scene(vehicle).geometry.values())
    np.testing.assert_allclose(stl.bounds, scene(vehicle).bounds, atol=1e-6)
    solids = sum(mesh.volume for mesh in scene(vehicle).geometry.values())
    assert stl.volume == pytest.approx(solids, rel=1e-4)
    assert (edge_counts(stl) % 2 == 0).all(), "an open edge"


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_target_file_has_only_known_keys_and_unit_vectors(vehicle: str) -> None:
    content = target(vehicle)
    assert content["name"] == vehicle
    assert set(content) <= {"name", "description", *KEYS}
    assert content["mesh"] == {"path": f"{vehicle}.glb", "unit": "m"}
    for table, keys in KEYS.items():
        entries = content.get(table, [])
        for entry in entries if isinstance(entries, list) else [entries]:
            assert set(entry) - {"circles"} == keys
            for direction in {"axis", "normal"} & keys:
                assert np.linalg.norm(entry[direction]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_builder_writes_the_same_bytes_again(vehicle: str, tmp_path: Path) -> None:
    builder = MODELS / vehicle / "build.py"
    command = [sys.executable, "-W", "error", str(builder), str(tmp_path), "--no-picture"]
    subprocess.run(command, check=True, capture_output=True, timeout=MOST_S)
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == sorted(["target.toml", f"{vehicle}.glb", f"{vehicle}.stl"])
    for name in written:
        assert (tmp_path / name).read_bytes() == (MODELS / vehicle / name).read_bytes(), name


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_picture_shows_the_vehicle(vehicle: str) -> None:
    with Image.open(MODELS / vehicle / f"{vehicle}.png") as picture:
        grey = np.asarray(picture.convert("L"))
    assert grey.shape == (480, 640)
    assert 0.04 < (grey > 60).mean() < 0.6


@pytest.mark.parametrize("vehicle", VEHICLES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turn_about_a_frame_axis_moves_the_vehicle_off_itself(vehicle: str, axis: int) -> None:
    vertices = np.vstack([mesh.vertices for mesh in scene(vehicle).geometry.values()])
    signs = -np.ones(3)
    signs[axis] = 1.0
    extreme = vertices[np.unique([*vertices.argmin(axis=0), *vertices.argmax(axis=0)])]
    gap = np.linalg.norm((extreme * signs)[:, None] - vertices[None], axis=2).min(axis=1)
    assert gap.max() > 0.03 * np.ptp(vertices, axis=0).max()


def test_hubble_tube_is_13_2_m_long_and_4_27_m_wide() -> None:
    tube = [part("hubble", name) for name in ("aft-shroud", "light-shield")]
    assert tube[1].bounds[1, 0] - tube[0].bounds[0, 0] == pytest.approx(13.2, abs=0.01)
    assert tube[0].extents[1:] == pytest.approx(4.27, abs=0.01)
    assert tube[1].extents[1:] == pytest.approx(3.05, abs=0.05)
    assert tube[0].bounds[0, 0] == pytest.approx(-6.6, abs=1e-6)


@pytest.mark.parametrize("side", ["plus-v2", "minus-v2"])
def test_hubble_arrays_are_7_1_by_2_6_m(side: str) -> None:
    boards = parts_like("hubble", f"array-{side}", "-board")
    singular = np.linalg.svd(boards.vertices - boards.vertices.mean(axis=0))[2]
    lengths = np.ptp(boards.vertices @ singular.T, axis=0)
    assert np.sort(lengths)[1:] == pytest.approx([2.6, 7.1], abs=0.01)


def test_hubble_arrays_stand_at_unequal_angles() -> None:
    up = []
    for side in ("plus-v2", "minus-v2"):
        mesh = part("hubble", f"array-{side}-00-board")
        up.append(mesh.face_normals[mesh.area_faces.argmax()] @ [0.0, 0.0, 1.0])
    assert abs(abs(up[0]) - abs(up[1])) > 0.05


def test_hubble_door_is_open_105_degrees() -> None:
    door = part("hubble", "aperture-door")
    normal = door.face_normals[door.area_faces.argmax()]
    assert abs(normal[0]) == pytest.approx(np.cos(np.radians(75.0)), abs=1e-4)
    assert door.bounds[0, 0] > 6.5


def test_client_ring_lies_on_the_mesh_and_stands_proud_of_the_face() -> None:
    ring = target("client")["docking_ring"]
    assert ring["radius_m"] == pytest.approx(1.194 / 2)
    angles = np.linspace(0.0, 2.0 * np.pi, 37)
    circle = np.column_stack([0.0 * angles, np.cos(angles), np.sin(angles)])
    points = np.array(ring["centre_m"]) + ring["radius_m"] * circle
    assert distance(part("client", "docking-ring"), points).max() < 0.001
    assert ring["centre_m"][0] < part("client", "bus").bounds[0, 0] - 0.2
    assert ring["centre_m"][0] == pytest.approx(part("client", "docking-ring").bounds[0, 0])


@pytest.mark.parametrize(("group", "scale"), [("far", 1.0), ("near", 0.4)])
def test_client_targets_have_the_shape_of_book_et_al(group: str, scale: float) -> None:
    spots = {
        entry["name"]: np.array(entry["position_m"])
        for entry in target("client")["reflectors"]
        if entry["group"] == group
    }
    left, middle, right = (spots[f"{group}-{where}"] for where in ("left", "middle", "right"))
    assert np.linalg.norm(left - right) == pytest.approx(14.5 * INCH * scale, abs=1e-5)
    pole = middle - 0.5 * (left + right)
    np.testing.assert_allclose(pole, [-4.0 * INCH * scale, 0.0, 0.0], atol=1e-5)


def test_client_reflectors_are_mounted_and_seen_from_minus_x() -> None:
    everything = parts_like("client", "")
    for entry in target("client")["reflectors"]:
        group, position = entry["group"], np.array(entry["position_m"])
        assert distance(part("client", f"target-{group}-reflectors"), position)[0] < 1e-5
        mount = "pole" if entry["name"].endswith("middle") else "plate"
        assert distance(part("client", f"target-{group}-{mount}"), position)[0] < 0.01
        normal = np.array(entry["normal"])
        assert is_hidden(everything, position + normal, -normal)
        assert not is_hidden(everything, position + 0.001 * normal, normal), entry["name"]


def test_scole_plate_mast_and_antenna_have_their_published_sizes() -> None:
    plate, mast = part("scole", "platform"), part("scole", "mast")
    np.testing.assert_allclose(
        plate.extents, np.array([83.8, 54.0, 13.0 / 16.0]) * INCH, atol=0.001
    )
    assert plate.bounds[0, 0] == pytest.approx(-26.8 * INCH, abs=1e-5)
    assert mast.bounds[1, 2] - plate.bounds[1, 2] == pytest.approx(120.0 * INCH, abs=1e-5)
    centre = part("scole", "antenna-rim").bounds.mean(axis=0)
    assert centre[:2] == pytest.approx([12.0 * INCH, 20.8 * INCH], abs=0.002)


def test_scole_leds_sit_on_the_plate_in_one_plane_and_in_the_open() -> None:
    leds = target("scole")["leds"]
    assert len(leds) == 6
    positions = np.array([entry["position_m"] for entry in leds])
    normals = np.array([entry["normal"] for entry in leds])
    assert np.ptp(positions[:, 2]) == 0.0
    assert np.linalg.matrix_rank(positions[:, :2] - positions[:, :2].mean(axis=0), tol=0.1) == 2
    everything = parts_like("scole", "")
    for k, position in enumerate(positions):
        assert distance(part("scole", f"led-{k + 1}"), position)[0] < 1e-5
    feet = positions - 0.012 * normals
    assert distance(part("scole", "platform"), feet).max() < 0.001
    for position, normal in zip(positions, normals, strict=True):
        assert not is_hidden(everything, position + 0.001 * normal, normal)


def test_shuttle_has_its_published_length_span_and_fin() -> None:
    low, high = scene("shuttle").bounds
    assert high[0] - low[0] == pytest.approx(37.24, abs=0.02)
    assert high[1] - low[1] == pytest.approx(23.79, abs=0.01)
    assert low[2] == pytest.approx(-(816.0 - 400.0) * INCH, abs=0.2)


def test_shuttle_doors_close_the_bay() -> None:
    """Both doors, turned by the angle of the file, meet above the bay and hide its floor."""
    shuttle = Target.load(MODELS / "shuttle" / "doors.toml")
    (doors,) = (one.joint for one in shuttle.joints)
    mesh = with_parts(load_mesh(shuttle.mesh_path, shuttle.unit), shuttle)
    inside, up = np.array([0.3, 0.2, 1.9]), np.array([0.0, 0.0, -1.0])
    for angle_rad, hidden in ((doors.lowest_rad, False), (doors.highest_rad, True)):
        turned = posed(mesh, [doors], [angle_rad])
        surface = trimesh.Trimesh(turned.vertices_m, turned.faces, process=False)
        assert is_hidden(surface, inside, up) == hidden
        own = turned.vertices_m[turned.faces[turned.face_part == 1]].reshape(-1, 3)
        other = turned.vertices_m[turned.faces[turned.face_part == 2]].reshape(-1, 3)
        assert len(own) == len(other) > 0
        assert own[:, 1].max() == pytest.approx(-other[:, 1].min(), abs=1e-4)
    assert own[:, 1].min() == pytest.approx(0.0, abs=0.01), "they meet in the middle"
    assert own[:, 2].min() == pytest.approx(-2.62, abs=0.01)


def test_a_wheel_has_every_vehicle() -> None:
    """A checkout finds them in its own folder, whatever is packed."""
    built = tomllib.loads((MODELS.parent / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    packed = built["targets"]["wheel"]["force-include"]
    assert packed == {f"models_cad/{v}": f"rendezview/models_cad/{v}" for v in VEHICLES}
