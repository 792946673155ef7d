"""`rendezview track --prior LOG`: a lost target is searched where other sensors expect it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.io.pose_log import poses_by_frame
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance.following import follow
from rendezview_ground.simulate.bop_writer import BopSceneWriter

DARK = range(3, 10)


@pytest.fixture(scope="module")
def lost_and_found(refining_model, bumpy_mesh, camera, draw, tmp_path_factory) -> Path:
    """Three frames, seven dark ones in which the target turns by 100°, and three more."""
    folder, rng = tmp_path_factory.mktemp("lost"), np.random.default_rng(8)
    lines = []
    with BopSceneWriter(folder / "scene", camera) as scene:
        for k in range(13):
            degrees = 0.2 * k if k < DARK.start else 100.0
            turned = Rotation.from_rotvec([0.0, np.deg2rad(degrees), 0.0])
            rotation = (turned * Rotation.from_rotvec([0.4, -0.7, 0.2])).as_matrix()
            centre = np.array([0.0, 0.0, 1.6 * refining_model.sphere_radius_m])
            pose = Pose(rotation, centre - rotation @ refining_model.centre_m)
            image = draw(bumpy_mesh, pose, camera, rng)
            scene.add(k, np.zeros_like(image) if k in DARK else image, pose, float(k))
            near = pose.perturbed(np.deg2rad([1.0, -1.0, 0.5, 0.0, 0.0, 0.0]))
            covariance = np.diag([0.02**2] * 3 + [0.05**2] * 3).tolist()
            lines.append({"time_s": float(k), "pose": near.as_dict(), "covariance": covariance})
    (folder / "fused.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_the_frame_after_an_outage_is_searched_near_its_line(refining_model, lost_and_found):
    sequence = open_sequence(lost_and_found / "scene")
    known = poses_by_frame(lost_and_found / "fused.jsonl", lambda *known: known)
    for expected, independent, near, without in (
        (known, False, range(13), DARK),
        (known, True, range(13), DARK),
        # All attitudes are searched at first and after a while. A second frame confirms the turn.
        (None, False, (1, 2, 11, 12), range(3, 11)),
    ):
        told = follow(refining_model, sequence, expected=expected, independent=independent)
        seen = {frame.im_id: (frame, observation) for frame, observation in told}
        for k, (frame, observation) in seen.items():
            assert (observation.pose is None) == (k in without)
            if observation.pose is not None:
                off = observation.pose.angle_to(frame.camera_from_target)
                assert np.rad2deg(off) < 1.0
                assert observation.found.prior == (k in near)


def test_the_command_takes_a_log_and_names_a_wrong_one(
    run, refining_model, lost_and_found, tmp_path
):
    refining_model.save(tmp_path / "m.rvm")
    asked = ("track", tmp_path / "m.rvm", lost_and_found / "scene", "-o", tmp_path / "p.csv")
    ran = run(*asked, "--prior", lost_and_found / "fused.jsonl")
    assert ran.code == 0, ran
    assert "6 poses in 13 frames" in ran.err
    (tmp_path / "bad.jsonl").write_text('{"im_id": 1}\n')
    run(*asked, "--prior", tmp_path / "bad.jsonl").says("no line of a log of poses")
    run(*asked, "--prior", tmp_path / "none.jsonl").says("none.jsonl")
    late = tmp_path / "late.jsonl"  # of the same run by another clock
    lines = [json.loads(line) for line in (lost_and_found / "fused.jsonl").read_text().splitlines()]
    late.write_text("".join(json.dumps(line | {"time_s": 1.7e9}) + "\n" for line in lines))
    run(*asked, "--prior", late).says("none of its poses is of these frames")
    late.write_text("".join(json.dumps(line | {"pose": None}) + "\n" for line in lines))
    assert run(*asked, "--prior", late).code == 0  # nothing was expected anywhere
