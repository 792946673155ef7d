"""Rerun recordings, read back by Rerun's own reader."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import JsonLinesWriter
from rendezview.io.sequences import open_sequence
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_service.viewers.rerun_file import write_rerun
from rendezview_service.viewers.runs import Moment, moments

chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk")
CAMERA = Camera.from_fov(64, 48, 1.0)
COVARIANCE = np.diag([1e-6, 4e-6, 4e-6, 1e-4, 1e-4, 2e-4])


def poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(61)
    turns = Rotation.random(count, random_state=rng).as_matrix()
    return [Pose(turn, [0.1 * k, -0.2, 9.0 + k]) for k, turn in enumerate(turns)]


class Recording:
    """What is in a recording, by entity and component: (frame, value) in order."""

    def __init__(self, path: Path) -> None:
        self.columns: dict[str, list[tuple[int | None, object]]] = {}
        for part in chunk.RrdReader(path).stream().to_chunks():
            table = part.to_record_batch()
            names = [name for name in table.schema.names if ":" in name]
            timed = "frame" in table.schema.names
            frames = table.column("frame").to_pylist() if timed else [None] * part.num_rows
            for name in names:
                values = table.column(name).to_pylist()
                column = self.columns.setdefault(f"{part.entity_path} {name}", [])
                column += [p for p in zip(frames, values, strict=True) if p[1] is not None]
        for column in self.columns.values():
            column.sort(key=lambda pair: -1 if pair[0] is None else pair[0])

    def values(self, entity: str, component: str) -> dict[int | None, list]:
        found = self.columns.get(f"{entity} {component}", [])
        return {frame: value for frame, value in found if isinstance(value, list)}


@pytest.fixture
def run_log(tmp_path: Path) -> Path:
    """Five frames; the third has no pose."""
    with BopSceneWriter(tmp_path / "scene", CAMERA) as scene:
        for k, pose in enumerate(poses(5)):
            scene.add(k, np.full((48, 64), 10 * k, np.uint8), pose, 0.5 * k)
    with JsonLinesWriter(tmp_path / "log.jsonl") as log:
        for k, pose in enumerate(poses(5)):
            found = pose.perturbed([0, 0, 0.01 * k, 0, 0, 0.1 * k])
            lost = k == 2
            log.write(
                {
                    "im_id": k,
                    "time_s": 0.5 * k,
                    "status": "lost" if lost else "ok",
                    "reason": "too dark" if lost else None,
                    "pose": None if lost else found,
                    "covariance": None if lost else COVARIANCE,
                    "score": 0.5 + 0.1 * k,
                    "stage_ms": {"trees": 1.0 + k},
                    "candidates": [],
                }
            )
    return tmp_path / "log.jsonl"


def test_poses_pictures_and_numbers_are_those_of_the_run(run_log: Path, tmp_path: Path) -> None:
    scene = open_sequence(tmp_path / "scene")
    assert write_rerun(tmp_path / "run.rrd", moments(run_log, scene)) == 5
    found = Recording(tmp_path / "run.rrd")
    places = found.values("/target", "Transform3D:translation")
    turns = found.values("/target", "Transform3D:quaternion")
    scales = found.values("/target", "Transform3D:scale")
    for k, truth in enumerate(poses(5)):
        if k == 2:
            assert not places.get(k)
            assert scales[k] == [[0.0, 0.0, 0.0]]  # nowhere
            continue
        pose = truth.perturbed([0, 0, 0.01 * k, 0, 0, 0.1 * k])
        np.testing.assert_allclose(places[k][0], pose.translation_m, rtol=1e-6)
        back = Rotation.from_quat(turns[k][0]).as_matrix()
        np.testing.assert_allclose(back, pose.rotation, atol=1e-6)
        assert not scales.get(k)
    truths = found.values("/truth", "Transform3D:translation")
    np.testing.assert_allclose(truths[4][0], poses(5)[4].translation_m, rtol=1e-6)
    assert len(found.columns["/camera/image EncodedImage:blob"]) == 5
    ((_, matrix),) = found.columns["/camera/image Pinhole:image_from_camera"]
    np.testing.assert_allclose(np.reshape(matrix, (3, 3)).T, CAMERA.matrix, rtol=1e-6)
    assert found.values("/plots/score", "Scalars:scalars")[3] == pytest.approx([0.8])
    assert found.values("/plots/stage_ms/trees", "Scalars:scalars")[1] == [2.0]
    sigmas = found.values("/plots/sigma/rotation_deg", "Scalars:scalars")
    assert sigmas[0] == pytest.approx([math.degrees(3e-3)])
    assert sorted(sigmas) == [0, 1, 3, 4]
    errors = found.values("/plots/error/rotation_deg", "Scalars:scalars")
    assert errors[4] == pytest.approx([math.degrees(0.04)])
    told = found.values("/status", "TextLog:text")
    assert told == {0: ["ok"], 2: ["lost: too dark"], 3: ["ok"]}


def test_times_since_1970_and_times_of_the_run_are_told_apart(tmp_path: Path) -> None:
    for start_s, kind in ((0.0, "duration"), (1.7e9, "timestamp")):
        record = {"status": "ok", "time_s": start_s + 0.25, "pose": None}
        path = tmp_path / f"{kind}.rrd"
        write_rerun(path, [Moment(0, start_s + 0.25, record)])
        (column,) = {
            str(part.to_record_batch().schema.field("time").type)
            for part in chunk.RrdReader(path).stream().to_chunks()
            if "time" in part.timeline_names
        }
        assert column.startswith(kind)


def test_a_ring_and_spots_are_drawn(tmp_path: Path) -> None:
    ellipse = {"centre_px": [20.0, 10.0], "semi_axes_px": [8.0, 4.0], "angle_rad": math.pi / 2}
    ring = {
        "status": "ok",
        "ellipses": [ellipse],
        "poses": [
            {"centre_m": [0.0, 0.1, 5.0], "axis": [0.0, 0.0, -1.0], "chosen": True},
            {"centre_m": [0.0, 0.1, 5.0], "axis": [0.1, 0.0, -0.99], "chosen": False},
        ],
    }
    spots = {"status": "ok", "spots": [{"x_px": 3.0, "y_px": 4.0}], "pose": None}
    run = [Moment(0, 0.0, ring, CAMERA), Moment(1, 1.0, spots, CAMERA)]
    write_rerun(tmp_path / "run.rrd", run)
    found = Recording(tmp_path / "run.rrd")
    drawn = found.values("/camera/image/ellipses", "LineStrips2D:strips")
    strip = np.array(drawn[0][0])
    assert strip[:, 1].max() == pytest.approx(18.0)  # turned upright
    assert strip[:, 0].max() == pytest.approx(24.0)
    assert not drawn.get(1)  # gone where the next frame has none
    assert found.values("/camera/image/spots", "Points2D:positions")[1] == [[3.0, 4.0]]
    assert len(found.values("/ring", "Arrows3D:origins")[0]) == 2


def test_what_a_service_reads_is_drawn_and_disappears(tmp_path: Path) -> None:
    bent = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    truth = poses(1)[0]
    turn = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    ellipse = {"centre_px": [50.0, 23.5], "semi_axes_px": [8.0, 4.0], "angle_rad": 0.0}
    circle = {"centre_m": [0.0, 0.1, 5.0], "axis": [0.0, 0.0, -1.0], "chosen": True}
    state = {
        "status": "ok",
        "pose": truth.as_dict(),
        "fused": {"pose": truth.as_dict()},
        "ring": {"status": "ok", "ellipse": ellipse, "poses": [circle], "candidates": []},
        "reflectors": {"spots": [{"x_px": 3.0, "y_px": 4.0, "reflector": "left"}]},
        "trajectory": {
            "centre_m": [0.0, 0.0, 1.0],
            "path_from_target": turn.tolist(),
            "segment": {"path_m": [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], "predicted_m": [[3.0, 0, 0]]},
        },
    }
    later = {"status": "lost", "reason": "dark", "pose": None, "fused": None, "ring": None}
    run = [Moment(0, 0.0, state, bent), Moment(1, 1.0, later, bent)]
    write_rerun(tmp_path / "run.rrd", run)
    found = Recording(tmp_path / "run.rrd")
    axes = found.values("/fused", "Arrows3D:vectors")[0]
    np.testing.assert_allclose(np.transpose(axes), truth.rotation, atol=1e-6)
    strips = found.values("/target/path", "LineStrips3D:strips")
    # Places are about the centre, in the axes of the path.
    expected = turn.T @ [1.0, 0.0, 0.0] + np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(strips[0][0][0], expected, atol=1e-6)
    drawn = np.array(found.values("/camera/image/ring", "LineStrips2D:strips")[0][0])
    assert drawn[:, 0].max() < 57.0  # 58 without the lens, which pulls inwards
    assert found.values("/camera/image/reflectors", "Points2D:positions")[0] == [[3.0, 4.0]]
    for entity in ("/fused", "/ring", "/target/path", "/camera/image/ring"):
        assert 1 in found.values(entity, "Clear:is_recursive"), entity


def test_a_fused_pose_that_is_none_is_refused(tmp_path: Path) -> None:
    record = {"status": "ok", "pose": None, "fused": {"pose": {"quat_wxyz": [1.0]}}}
    with pytest.raises(RendezviewError, match="fused: pose:"):
        write_rerun(tmp_path / "run.rrd", [Moment(0, 0.0, record)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no line"),
        ('{"a": 1}', "line 1: has no status"),
        ('{"status": "ok", "time_s": "now"}', "line 1: has no status or no time"),
        ('{"status": "ok", "im_id": 9, "time_s": 0.0}', "im_id 9 is no frame of"),
    ],
)
def test_what_is_no_log_of_this_scene_is_refused(
    run_log: Path, tmp_path: Path, text: str, message: str
) -> None:
    run_log.write_text(text)
    out = tmp_path / "run.rrd"
    with pytest.raises(RendezviewError, match=message):
        write_rerun(out, moments(run_log, open_sequence(tmp_path / "scene")))
    assert not list(tmp_path.glob("*.rrd"))
    assert not list(tmp_path.glob(".*rrd"))


def test_a_pose_that_is_none_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    log.write_text(json.dumps({"status": "ok", "time_s": 0.0, "pose": {"quat_wxyz": [0, 0, 0, 0]}}))
    with pytest.raises(RendezviewError, match="frame 0: pose:"):
        write_rerun(tmp_path / "run.rrd", moments(log))
    assert not list(tmp_path.glob("*.rrd"))
    with pytest.raises(RendezviewError, match="existing folder"):
        write_rerun(tmp_path / "no" / "run.rrd", moments(log))
