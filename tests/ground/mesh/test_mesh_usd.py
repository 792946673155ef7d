"""USD stages as CAD models."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.colours import GREY
from rendezview_ground.mesh.mesh import load_mesh

STAGE = """#usda 1.0
(
    metersPerUnit = 0.001
    upAxis = "Z"
)
def Xform "craft"
{
    double3 xformOp:translate = (1000, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "body"
    {
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
        point3f[] points = [(0, 0, 0), (800, 0, 0), (0, 600, 0), (800, 600, 0),
            (0, 0, 400), (800, 0, 400), (0, 600, 400), (800, 600, 400)]
        uniform token subdivisionScheme = "none"
        color3f[] primvars:displayColor = [(0.2, 0.4, 0.1)]
    }
    def Xform "wing"
    {
        double xformOp:rotateZ = 90
        uniform token[] xformOpOrder = ["xformOp:rotateZ"]
        def Mesh "panel" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            rel material:binding = </paint>
            int[] faceVertexCounts = [5, 3]
            int[] faceVertexIndices = [0, 1, 2, 3, 4, 0, 4, 5]
            point3f[] points = [(0, 0, 0), (2000, 0, 0), (1000, 300, 0), (2000, 900, 0),
                (0, 900, 0), (-500, 450, 0)]
            uniform token subdivisionScheme = "none"
        }
    }
    def Mesh "hidden"
    {
        token visibility = "invisible"
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (90000, 0, 0), (0, 90000, 0)]
    }
    def Sphere "ball" {}
}
def Material "paint"
{
    token outputs:surface.connect = </paint/shader.outputs:surface>
    def Shader "shader"
    {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (0.05, 0.05, 0.3)
        token outputs:surface
    }
}
"""  # noqa: E501


@pytest.fixture
def stage_path(tmp_path: Path) -> Path:
    path = tmp_path / "craft.usda"
    path.write_text(STAGE)
    return path


def test_the_meshes_of_a_stage_are_placed_scaled_cut_and_coloured(stage_path: Path) -> None:
    pytest.importorskip("pxr")
    mesh = load_mesh(stage_path)
    assert len(mesh.faces) == 12 + 3 + 1  # six quads, a concave pentagon, a triangle
    assert mesh.vertices_m.min(axis=0) == pytest.approx([0.1, -0.5, 0.0])
    assert mesh.vertices_m.max(axis=0) == pytest.approx([1.8, 2.0, 0.4])
    corners = mesh.vertices_m[mesh.faces]
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # The pentagon without its dent (0.45 m²), and the triangle.
    assert areas.sum() == pytest.approx(2 * (0.48 + 0.32 + 0.24) + (1.8 - 0.45) + 0.225)
    painted = np.all(np.isclose(mesh.face_rgb, [0.05, 0.05, 0.3]), axis=1)
    assert painted.sum() == 4
    assert np.allclose(mesh.face_rgb[~painted], [0.2, 0.4, 0.1])
    said = " ".join(mesh.notes)
    for words in ("units of 0.001 m (USD)", "up axis is Z", "1 of them concave", "1 body without"):
        assert words in said


def test_a_prim_is_read_by_name_with_all_below_it(stage_path: Path) -> None:
    pytest.importorskip("pxr")
    assert len(load_mesh(Path(f"{stage_path}#wing")).faces) == 4
    assert len(load_mesh(Path(f"{stage_path}#craft")).faces) == 16
    with pytest.raises(RendezviewError, match=r"no prim 'bus'; it has craft, body, wing, panel"):
        load_mesh(Path(f"{stage_path}#bus"))


def test_a_binary_stage_without_a_unit_is_in_centimetres_and_grey(tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    stage = usd.Stage.CreateNew(str(tmp_path / "plain.usdc"))
    mesh = UsdGeom.Mesh.Define(stage, "/part")
    mesh.CreatePointsAttr([(0, 0, 0), (100, 0, 0), (0, 100, 0), (0, 0, 100)])
    mesh.CreateFaceVertexCountsAttr([3, 3, 3, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 0, 1, 3, 0, 2, 3, 1, 2, 3])
    stage.GetRootLayer().Save()
    found = load_mesh(tmp_path / "plain.usdc")
    assert found.extent_m == pytest.approx([1.0, 1.0, 1.0])
    assert np.allclose(found.face_rgb, GREY)
    assert any("control cage" in note for note in found.notes)
    assert any("which is its default" in note for note in found.notes)


def test_what_is_no_stage_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    (tmp_path / "a.usda").write_text("no stage\n")
    with pytest.raises(RendezviewError, match=r"a\.usda cannot be read as USDA"):
        load_mesh(tmp_path / "a.usda")


def test_without_the_extra_a_usd_file_names_it(
    stage_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(RendezviewError, match=r"pip install 'rendezview\[usd\]', or export"):
        load_mesh(stage_path)
