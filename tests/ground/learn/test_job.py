"""The training job: the same bytes whatever happens on the way, and refusals in words."""

from __future__ import annotations

import dataclasses
import pickle
import signal
from pathlib import Path

import numpy as np
import pytest
from tests.processes import python
from tests.quick_training import EVERY_STAGE, FEW_STAGES

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.learn.job import provenance, train
from rendezview_ground.learn.options import view_geometry
from rendezview_ground.mesh.mesh import Mesh

STOPPED = """
import os, pickle, signal, sys
from pathlib import Path
from rendezview_ground.learn.job import train
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
mesh, options = pickle.loads(Path(sys.argv[1]).read_bytes())
stop = int(sys.argv[3])

def progress(stage, done, of):
    if stage == sys.argv[5] and done == 1:
        os.kill(os.getpid(), stop)

train(mesh, Path(sys.argv[2]), name="bumpy", options=options, jobs=int(sys.argv[4]),
      progress=progress)
"""


@pytest.fixture(scope="module")
def by_two_jobs(tmp_path_factory, bumpy_mesh) -> tuple[bytes, list[tuple[str, int, int]]]:
    """The bytes of a model, and what its training reported."""
    path, steps = tmp_path_factory.mktemp("jobs") / "bumpy.rvm", []
    train(
        bumpy_mesh,
        path,
        name="bumpy",
        options=EVERY_STAGE,
        jobs=2,
        progress=lambda *step: steps.append(step),
    )
    return path.read_bytes(), steps


def stopped(
    folder: Path, mesh: Mesh, by: signal.Signals, stage: str, jobs: int = 1
) -> tuple[Path, int]:
    """The model that a process was to write, and how it ended in a stage of its training."""
    folder.mkdir()
    inputs, path = folder.parent / "inputs.pickle", folder / "bumpy.rvm"
    inputs.write_bytes(pickle.dumps((mesh, FEW_STAGES)))
    return path, python("-c", STOPPED, inputs, path, int(by), jobs, stage).returncode


@pytest.mark.requirement("RV-TRAIN-1")
def test_two_jobs_give_the_bytes_of_one(by_two_jobs, every_stage):
    assert by_two_jobs[0] == every_stage


def test_another_seed_gives_other_trees_of_the_same_views(tmp_path, bumpy_mesh, few_stages):
    options = dataclasses.replace(FEW_STAGES, seed=1, contour_points=0)
    train(bumpy_mesh, tmp_path / "m.rvm", name="bumpy", options=options, jobs=1)
    (tmp_path / "0.rvm").write_bytes(few_stages)
    first, other = (ViewModel.load(tmp_path / name) for name in ("0.rvm", "m.rvm"))
    assert np.array_equal(first.views.readings, other.views.readings)
    assert not np.array_equal(first.forest.threshold, other.forest.threshold)


@pytest.mark.requirement("RV-TRAIN-2")
def test_a_killed_job_goes_on_where_it_stopped_and_gives_the_same_bytes(
    tmp_path, bumpy_mesh, few_stages
):
    path, code = stopped(tmp_path / "run", bumpy_mesh, signal.SIGKILL, "trees")
    assert code == -signal.SIGKILL
    assert not path.exists()
    shards = sorted((path.parent / "bumpy.rvm.partial").glob("*/*.npz"))
    assert len(shards) >= 6
    # the disk may have kept less than what was written: those shards are drawn again
    damage = {"lattice": 0.5, "views-00000": 0.0, "views-00001": 0.9}
    for shard in shards:
        for name, kept in damage.items():
            if shard.name.startswith(name):
                content = shard.read_bytes()
                shard.write_bytes(content[: int(kept * len(content))])
    first: dict[str, tuple[int, int]] = {}
    train(
        bumpy_mesh,
        path,
        name="bumpy",
        options=FEW_STAGES,
        jobs=1,
        progress=lambda stage, done, of: first.setdefault(stage, (done, of)),
    )
    assert first["lattice"] == (0, 3)
    assert first["perspective"] == (3, 3)
    assert first["views"] == (3, 5)
    assert first["held-out"] == (1, 1)
    assert first["trees"] == (1, 11)
    assert path.read_bytes() == few_stages
    assert [p.name for p in path.parent.iterdir()] == ["bumpy.rvm"]


def test_ctrl_c_stops_two_jobs_and_leaves_no_half_model(tmp_path, bumpy_mesh):
    """Of one job: tests/cli/test_interruption.py."""
    path, code = stopped(tmp_path / "run", bumpy_mesh, signal.SIGINT, "views", jobs=2)
    assert code in (-signal.SIGINT, 130, 1)
    assert [p.name for p in path.parent.iterdir()] == ["bumpy.rvm.partial"]


def test_shards_of_other_inputs_are_not_used(tmp_path, bumpy_mesh, few_stages):
    path = tmp_path / "m.rvm"

    def stop(stage: str, done: int, of: int) -> None:
        if stage == "contours":
            raise InterruptedError

    other = dataclasses.replace(FEW_STAGES, seed=9)
    with pytest.raises(InterruptedError):
        train(bumpy_mesh, path, name="b", options=other, jobs=1, progress=stop)
    assert not path.exists()
    train(bumpy_mesh, path, name="bumpy", options=FEW_STAGES, jobs=1)
    assert path.read_bytes() == few_stages


def test_progress_counts_up_to_the_end_of_each_stage(by_two_jobs):
    reported: dict[str, list[int]] = {}
    ends = {}
    for stage, done, of in by_two_jobs[1]:
        reported.setdefault(stage, []).append(done)
        ends[stage] = of
    assert list(reported) == [
        "surface",
        "lattice",
        "perspective",
        "views",
        "held-out",
        "contours",
        "shadows",
        "sketches",
        "shape",
        "trees",
        "forest",
        "calibration",
    ]
    for stage, counts in reported.items():
        assert counts == list(range(ends[stage] + 1))


def test_a_model_says_how_it_was_made(tiny_model, tiny_options, bumpy_mesh):
    made = tiny_model.provenance
    assert made["options"]["perturbed_views"] == tiny_options.perturbed_views
    assert made["triangles"] == len(bumpy_mesh.faces)
    assert len(made["mesh_sha256"]) == 64
    assert {"numpy", "numba", "rendezview"} <= set(made["versions"])
    assert tiny_model.centre_m == pytest.approx(bumpy_mesh.bounding_sphere[0])
    assert tiny_model.sphere_radius_m == pytest.approx(3.0 * tiny_model.target_radius_m)


def test_colours_and_parts_decide_a_model_like_the_shape(bumpy_mesh, tiny_options):
    part = np.zeros(len(bumpy_mesh.faces), np.uint8)
    same, *others = (
        provenance(dataclasses.replace(bumpy_mesh, **change), tiny_options, None)["mesh_sha256"]
        for change in ({}, {"face_rgb": 0.5 * bumpy_mesh.face_rgb}, {"face_part": part})
    )
    assert same == provenance(bumpy_mesh, tiny_options, None)["mesh_sha256"]
    assert len({same, *others}) == 3


def test_nodes_are_right_about_views_they_were_and_were_not_trained_on(tiny_model):
    assert tiny_model.training_accuracy.mean() > 0.99
    assert np.nanmean(tiny_model.held_out_accuracy) > 0.9
    assert len(tiny_model.forest) == 162
    assert 0.0 < tiny_model.held_out.direction_rad < np.deg2rad(8.0)
    assert 0.0 < tiny_model.held_out.range_fraction < 0.06


def test_the_papers_own_training_works_without_random_views(tmp_path, bumpy_mesh):
    options = dataclasses.replace(EVERY_STAGE, held_out_views=0).paper()
    made = train(bumpy_mesh, tmp_path / "m.rvm", name="b", options=options, jobs=1)
    assert made.decisions is None
    model = ViewModel.load(tmp_path / "m.rvm")
    assert np.isnan(model.held_out_accuracy).all()
    assert np.array_equal(model.views.area_slope, np.zeros(162))  # weak perspective: eq. 4a
    total = model.leaf_on.sum() + model.leaf_off.sum()
    assert total == 12 * (16 + 45) + 30 * 73
    assert model.training_accuracy.min() > 0.9


def test_the_sphere_fits_the_field_of_view_of_the_camera(bumpy_mesh):
    camera = Camera.from_fov(800, 600, np.deg2rad(40.0))
    geometry = view_geometry(bumpy_mesh, EVERY_STAGE, camera)
    angle = np.arcsin(geometry.target_radius_m / geometry.sphere_radius_m)
    assert 0.9 * camera.half_fov_rad < angle < camera.half_fov_rad
    assert geometry.flight_focal_px == pytest.approx(camera.fx)
    assert geometry.flight_half_px == pytest.approx(300.0)


def test_a_sphere_that_does_not_enclose_the_target_is_refused(tmp_path, bumpy_mesh):
    radius = bumpy_mesh.bounding_sphere[1]
    for factor in (0.3, 1.0, 1.04):
        options = dataclasses.replace(EVERY_STAGE, sphere_radius_m=factor * radius)
        with pytest.raises(RendezviewError, match="does not enclose"):
            train(bumpy_mesh, tmp_path / "m.rvm", name="b", options=options, jobs=1)
    assert list(tmp_path.iterdir()) == []


def test_a_camera_that_does_not_see_its_boresight_decides_no_sphere(bumpy_mesh):
    camera = Camera(100, 100, 80.0, 80.0, -30.0, 50.0)
    with pytest.raises(RendezviewError, match="boresight"):
        view_geometry(bumpy_mesh, EVERY_STAGE, camera)
    given = dataclasses.replace(EVERY_STAGE, sphere_radius_m=6.0)
    assert view_geometry(bumpy_mesh, given, camera).sphere_radius_m == 6.0


def test_a_place_where_no_model_can_be_written_is_refused_before_the_work(tmp_path, bumpy_mesh):
    for path in (tmp_path, tmp_path / "none" / "m.rvm"):
        with pytest.raises(RendezviewError, match="folder"):
            train(bumpy_mesh, path, name="b", options=EVERY_STAGE, jobs=1)


def test_no_jobs_at_all_are_refused(tmp_path, bumpy_mesh):
    with pytest.raises(RendezviewError, match="jobs"):
        train(bumpy_mesh, tmp_path / "m.rvm", name="b", options=EVERY_STAGE, jobs=0)
