"""BOP's measures of a surface, against their definitions and, where it is there, its toolkit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, discrete_turns
from rendezview_ground.evaluate.bop_models import bop_model
from rendezview_ground.evaluate.surface import ModelPoints, alike_of, surface_errors, turns_about

Z = np.array([0.0, 0.0, 1.0])
K = np.array([[800.0, 0.0, 320.0], [0.0, 790.0, 240.0], [0.0, 0.0, 1.0]])
FOURFOLD = Symmetry("discrete", Z, math.pi / 2)
ROUND = Symmetry("continuous", Z, None)
FLIP = Symmetry("discrete", np.array([1.0, 0.0, 0.0]), math.pi)


def turned(axis: Array, angle_rad: float) -> Array:
    return np.asarray(Rotation.from_rotvec(angle_rad * axis).as_matrix())


def cases(count: int = 6) -> list[tuple[Pose, Pose]]:
    rng = np.random.default_rng(41)
    truths = [
        Pose(Rotation.random(random_state=rng).as_matrix(), [*rng.uniform(-1, 1, 2), 12.0])
        for _ in range(count)
    ]
    sizes = [0.001, 0.02, 0.1, 0.3, 1.0, 2.0]
    return [(t, t.perturbed(s * rng.normal(size=6))) for t, s in zip(truths, sizes, strict=False)]


def points() -> Array:
    return np.asarray(np.random.default_rng(42).normal(size=(60, 3)))


@pytest.mark.parametrize("symmetries", [(), (FOURFOLD,), (ROUND,), (ROUND, FLIP)])
def test_each_measure_is_its_definition(symmetries: tuple[Symmetry, ...]) -> None:
    cloud = points()
    surface = ModelPoints.of(cloud, alike_of(symmetries))
    for truth, estimate in cases():
        found = surface_errors(truth, estimate, surface, K, 640)
        here = estimate.apply(cloud)
        mssd, mspd = [], []
        for turn in surface.alike:
            there = truth.apply(turn.apply(cloud))
            mssd.append(max(math.dist(a, b) for a, b in zip(here, there, strict=True)))
            a, b = here @ K.T, there @ K.T
            apart = a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]
            mspd.append(max(math.hypot(*row) for row in apart))
        there = truth.apply(cloud)
        each = np.linalg.norm(here[:, None] - there[None], axis=2)
        assert found.mssd_m == pytest.approx(min(mssd), rel=1e-9)
        assert found.mspd_px == pytest.approx(min(mspd), rel=1e-9)
        assert found.add_m == pytest.approx(np.diag(each).mean(), rel=1e-9)
        assert found.add_s_m == pytest.approx(each.min(axis=0).mean(), rel=1e-9)
    assert surface.diameter_m == pytest.approx(
        max(math.dist(a, b) for a in cloud for b in cloud), rel=1e-12
    )


def test_the_numbers_are_those_of_the_bop_toolkit(tmp_path: Path) -> None:
    toolkit = pytest.importorskip("bop_toolkit_lib.pose_error", reason="needs the BOP toolkit")
    from bop_toolkit_lib import inout, misc

    from rendezview.io.results import ResultRow, write_results

    cloud = points()
    info = {
        "symmetries_discrete": [np.diag([1.0, -1.0, -1.0, 1.0]).ravel().tolist()],
        "symmetries_continuous": [{"axis": Z.tolist(), "offset": [0, 0, 0]}],
    }
    turns = misc.get_symmetry_transformations(info, 0.01)
    surface = ModelPoints.of(cloud, alike_of((ROUND, FLIP)))
    rows = [ResultRow(3, k, 1, 0.5, estimate, 0.1) for k, (_, estimate) in enumerate(cases())]
    write_results(tmp_path / "rendezview_lm-test.csv", rows)
    passed, message = inout.check_bop_results(str(tmp_path / "rendezview_lm-test.csv"))
    assert passed, message
    read = inout.load_bop_results(tmp_path / "rendezview_lm-test.csv")
    for (truth, estimate), row in zip(cases(), read, strict=True):
        true = truth.rotation, 1000.0 * truth.translation_m[:, None]
        there = row["R"], row["t"]
        mm = 1000.0 * cloud
        found = surface_errors(truth, estimate, surface, K, 640)
        assert toolkit.mssd(*there, *true, mm, turns) == pytest.approx(1e3 * found.mssd_m)
        assert toolkit.mspd(*there, *true, K, mm, turns) == pytest.approx(found.mspd_px)
        assert toolkit.add(*there, *true, mm) == pytest.approx(1e3 * found.add_m)
        assert toolkit.adi(*there, *true, mm) == pytest.approx(1e3 * found.add_s_m)


def test_a_turn_that_changes_nothing_costs_nothing() -> None:
    square = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
    truth, _ = cases()[0]
    quarter = truth @ Pose(Rotation.from_rotvec(Z * math.pi / 2).as_matrix(), np.zeros(3))
    plain = surface_errors(truth, quarter, ModelPoints.of(square), K, 640)
    alike = surface_errors(truth, quarter, ModelPoints.of(square, alike_of([FOURFOLD])), K, 640)
    assert plain.mssd_m == pytest.approx(math.sqrt(2.0))
    assert plain.mspd_px > 50.0
    assert (alike.mssd_m, alike.mspd_px) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert plain.add_s_m == pytest.approx(0.0, abs=1e-9)


def test_a_pose_behind_the_camera_has_no_projection() -> None:
    truth, _ = cases()[0]
    behind = Pose(truth.rotation, -truth.translation_m)
    found = surface_errors(truth, behind, ModelPoints.of(points()), K, 640)
    assert found.mspd_px == math.inf
    assert found.mssd_m == pytest.approx(2.0 * float(np.linalg.norm(truth.translation_m)))


def test_pixels_count_as_in_a_picture_640_wide() -> None:
    truth, estimate = cases()[1]
    wide = surface_errors(truth, estimate, ModelPoints.of(points()), np.diag([2, 2, 1]) @ K, 1280)
    small = surface_errors(truth, estimate, ModelPoints.of(points()), K, 640)
    assert wide.mspd_px == pytest.approx(2.0 * small.mspd_px)
    assert wide.mspd_640_px == pytest.approx(small.mspd_640_px)
    assert small.mspd_640_px == small.mspd_px


def test_nothing_has_no_surface() -> None:
    with pytest.raises(ValueError, match=r"\(V, 3\)"):
        ModelPoints.of(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="one place"):
        ModelPoints.of(np.ones((4, 3)))


def write_models(folder: Path, **info: object) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "models_info.json").write_text(json.dumps({"7": {"diameter": 200.0, **info}}))
    return folder / "obj_000007.ply"


def test_a_bop_model_has_the_symmetries_of_its_file(tmp_path: Path) -> None:
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    half_turn[0, 3] = 100.0  # about an axis 50 mm off the origin
    model = bop_model(
        write_models(
            tmp_path,
            symmetries_discrete=[np.eye(4).ravel().tolist(), half_turn.ravel().tolist()],
            min_x=-10,
        )
    )
    assert model is not None
    assert (model.obj_id, model.diameter_m, len(model.alike), model.unused) == (7, 0.2, 2, 0)
    np.testing.assert_allclose(model.alike[1].apply([0.05, 0.0, 0.3]), [0.05, 0.0, 0.3])
    (aside,) = model.symmetries
    assert aside.angle_rad == pytest.approx(math.pi)
    np.testing.assert_allclose(aside.point_m, [0.05, 0.0, 0.0], atol=1e-12)
    offset = bop_model(
        write_models(
            tmp_path, symmetries_continuous=[{"axis": [0, 0, 2], "offset": [30.0, 0.0, 9.0]}]
        )
    )
    assert offset is not None
    assert (len(offset.alike), offset.unused) == (315, 0)
    for turn in offset.alike:
        np.testing.assert_allclose(turn.apply([0.03, 0.0, 1.0]), [0.03, 0.0, 1.0], atol=1e-12)
    (round_body,) = offset.symmetries
    assert round_body.kind == "continuous"
    np.testing.assert_allclose(round_body.point_m, [0.03, 0.0, 0.009])


def test_the_turns_of_a_bop_file_generate_each_other_although_rounded(tmp_path: Path) -> None:
    """All turns of a square box about a point, measured to 0.2° and 0.3 mm."""
    rng = np.random.default_rng(6)
    centre_mm = np.array([10.0, -20.0, 30.0])
    rows = []
    for quarter in range(4):
        for flip in (np.eye(3), np.diag([1.0, -1.0, -1.0])):
            error = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3) * np.deg2rad(0.1)).as_matrix()
            turn = error @ turned(Z, quarter * math.pi / 2) @ flip
            matrix = np.eye(4)
            matrix[:3, :3] = turn
            matrix[:3, 3] = centre_mm - turn @ centre_mm + rng.uniform(-0.3, 0.3, 3)
            rows.append(matrix.round(6).ravel().tolist())
    model = bop_model(write_models(tmp_path, symmetries_discrete=rows[1:]))
    assert model is not None
    assert len(discrete_turns(model.symmetries)) == 8
    assert (len(model.alike), model.unused) == (8, 0)
    for symmetry in model.symmetries:
        np.testing.assert_allclose(symmetry.point_m, centre_mm / 1000.0, atol=1e-3)


def test_turns_of_a_bop_file_that_no_body_has_count_in_surface_distances_only(
    tmp_path: Path,
) -> None:
    aside, along = np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0])
    aside[0, 3] = 100.0  # parallel to the first
    along[0, 3] = 40.0  # and moved along its axis
    rows = [np.diag([-1.0, -1.0, 1.0, 1.0]), aside, along]
    model = bop_model(
        write_models(tmp_path, symmetries_discrete=[row.ravel().tolist() for row in rows])
    )
    assert model is not None
    assert (len(model.alike), len(model.symmetries), model.unused) == (4, 1, 2)


def test_alike_poses_of_an_axis_beside_the_origin_keep_its_points() -> None:
    through = np.array([0.3, -0.2, 0.0])
    for symmetry in (
        Symmetry("discrete", Z, math.pi / 2, through),
        Symmetry("continuous", Z, None, through),
    ):
        alike = alike_of([symmetry])
        assert len(alike) == (4 if symmetry.kind == "discrete" else 315)
        for turn in alike:
            np.testing.assert_allclose(turn.apply([0.3, -0.2, 7.0]), [0.3, -0.2, 7.0], atol=1e-12)


def test_other_meshes_are_no_bop_models(tmp_path: Path) -> None:
    write_models(tmp_path)
    assert bop_model(tmp_path / "hubble.stl") is None
    assert bop_model(tmp_path / "elsewhere" / "obj_000007.ply") is None
    with pytest.raises(RendezviewError, match="no entry for object 8"):
        bop_model(tmp_path / "obj_000008.ply")


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"diameter": 0.0}, r"models_info\.json: 7\.diameter"),
        ({"symmetries_discrete": [[1.0] * 12]}, r"7\.symmetries_discrete"),
        ({"symmetries_discrete": [[0.0] * 16]}, r"7\.symmetries_discrete"),
        ({"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}, "axis is zero"),
    ],
)
def test_a_wrong_models_info_is_named(
    tmp_path: Path, info: dict[str, object], message: str
) -> None:
    with pytest.raises(RendezviewError, match=message):
        bop_model(write_models(tmp_path, **info))


def test_the_steps_of_a_turn_go_once_round() -> None:
    turns = turns_about(Z, np.array([1.0, 0.0, 0.0]))
    angles = [Rotation.from_matrix(t.rotation).magnitude() for t in turns]
    assert len(turns) == 315
    assert angles[0] == 0.0
    assert angles[1] == pytest.approx(2.0 * math.pi / 315)
    assert angles[-1] == pytest.approx(angles[1])
