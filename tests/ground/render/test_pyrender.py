"""Views drawn by pyrender, an independent renderer, beside ours."""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import pickle
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tests.processes import python
from tests.quick_training import FEW_STAGES, REFINING

from rendezview.cli.main import main
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.contours import POINT_UNIT
from rendezview_ground.learn.job import train
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.drawn_view import draw_view
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import Window
from rendezview_ground.render.pyrender_renderer import PyrenderRenderer
from rendezview_ground.render.rasterizer import NumbaRenderer
from rendezview_ground.render.renderers import Renderer, working_renderer

# Mesa's own libraries: libEGL alone may be a dispatcher without a driver. One of them is enough.
PLATFORM = next(
    (
        platform
        for platform, library in (("egl", "EGL_mesa"), ("osmesa", "OSMesa"))
        if ctypes.util.find_library(library) is not None
    ),
    None,
)
WINDOW = Window(90, 70, 80.0, 41.3, 36.9)


@pytest.fixture(scope="module")
def platform() -> Iterator[str]:
    if PLATFORM is None or importlib.util.find_spec("pyrender") is None:
        pytest.skip("EGL_mesa and OSMesa, or pyrender, are not installed here")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("PYOPENGL_PLATFORM", PLATFORM)
        yield PLATFORM


@contextmanager
def rendering(mesh: Mesh) -> Iterator[PyrenderRenderer]:
    """Its processes end here, whoever still holds it."""
    renderer = PyrenderRenderer(mesh)
    yield renderer
    for process in renderer._all:
        process.shutdown(kill_workers=True)


@pytest.fixture(scope="module")
def renderer(platform, bumpy_mesh) -> Iterator[PyrenderRenderer]:
    with rendering(bumpy_mesh) as renderer:
        yield renderer


def some_poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(4)
    rotations = Rotation.random(count, random_state=rng).as_matrix()
    return [Pose(r, [*rng.uniform(-0.5, 0.5, 2), 4.0]) for r in rotations]


def test_silhouettes_equal_ours_but_for_a_pixel_or_two_of_the_edge(renderer, bumpy_mesh):
    for pose in some_poses(5):
        ours = NumbaRenderer(bumpy_mesh).draw(pose, WINDOW)
        assert ours.any()
        assert np.count_nonzero(renderer.draw(pose, WINDOW) != ours) <= 2


def test_depths_and_faces_equal_ours(renderer, bumpy_mesh):
    geometry = view_geometry(bumpy_mesh, REFINING, None)
    for direction in Rotation.random(5, random_state=3).apply([0.0, 0.0, 1.0]):
        ours, other = (
            draw_view(bumpy_mesh, geometry, direction, 5.0, 128, 3.0, r) for r in (None, renderer)
        )
        same = ours.owner == other.owner
        assert np.count_nonzero(ours.owner >= 0) > 2000
        assert np.count_nonzero(~same) <= 0.002 * same.size  # on edges only
        assert other.nearness[same] == pytest.approx(ours.nearness[same], rel=1e-4)


def test_threads_draw_at_the_same_time_with_a_context_each(renderer, bumpy_mesh):
    poses = some_poses(24)
    windows = [Window(90 + 7 * (k % 5), 70, 80.0, 41.3, 36.9) for k in range(24)]
    with ThreadPoolExecutor(3) as pool:
        drawn = list(pool.map(renderer.draw, poses, windows))
    for mask, pose, window in zip(drawn, poses, windows, strict=True):
        ours = NumbaRenderer(bumpy_mesh).draw(pose, window)
        assert np.count_nonzero(mask != ours) <= 2


def test_a_renderer_travels_to_another_process_as_its_mesh(renderer):
    _, (mesh,) = renderer.__reduce__()
    again = pickle.loads(pickle.dumps(renderer))
    assert again._all == []  # neither drawing processes nor their pipes
    assert np.array_equal(again._mesh.vertices_m, mesh.vertices_m)
    assert np.array_equal(again._mesh.faces, mesh.faces)


def test_a_drawing_process_that_dies_is_an_error_and_the_next_view_gets_a_new_one(
    platform, bumpy_mesh
):
    pose = some_poses(1)[0]
    with rendering(bumpy_mesh) as renderer:
        before = renderer.draw(pose, WINDOW)
        (process,) = renderer._idle
        os.kill(next(iter(process._processes)), signal.SIGKILL)
        with pytest.raises(RendezviewError, match=r"ended: .*SIGKILL\(-9\)"):
            renderer.draw(pose, WINDOW)
        assert np.array_equal(renderer.draw(pose, WINDOW), before)


def trained(mesh: Mesh, path: Path, options: TrainingOptions, jobs: int = 1) -> ViewModel:
    train(mesh, path, name="bumpy", options=options, jobs=jobs)
    return ViewModel.load(path)


def test_a_model_drawn_by_pyrender_has_the_same_bytes_for_any_number_of_jobs(
    platform, bumpy_mesh, tmp_path
):
    options = replace(
        FEW_STAGES, order=0, perturbed_views=40, held_out_views=0, renderer=Renderer.PYRENDER
    )
    first, second = tmp_path / "1.rvm", tmp_path / "2.rvm"
    trained(bumpy_mesh, first, options)
    trained(bumpy_mesh, second, options, jobs=2)
    assert first.read_bytes() == second.read_bytes()


def test_a_model_drawn_by_pyrender_equals_ours_to_the_pixels_that_differ(
    platform, bumpy_mesh, tmp_path
):
    options = replace(
        REFINING, order=0, perturbed_views=40, held_out_views=0, forest_trees=2,
        contour_radii=(1.0,),
    )  # fmt: skip
    ours = trained(bumpy_mesh, tmp_path / "ours.rvm", options)
    by_pyrender = replace(options, renderer=Renderer.PYRENDER)
    other = trained(bumpy_mesh, tmp_path / "other.rvm", by_pyrender)
    assert other.provenance["options"]["renderer"] == "pyrender"
    # A pixel of an outline that differs moves a reading by a per mille or two.
    assert other.views.readings == pytest.approx(ours.views.readings, rel=0.01, abs=60)
    assert other.views.area_m2 == pytest.approx(ours.views.area_m2, rel=2e-3)
    # A pixel of an edge that differs shifts the choice of the points after it along the edge.
    pixel = 2.0 / 256.0 / POINT_UNIT  # of the drawn view, which the target's radius fills twice
    mine, its = (model.contours.point.reshape(-1, 158, 3) for model in (ours, other))
    off = np.concatenate([cKDTree(a).query(b)[0] for a, b in zip(mine, its, strict=True)])
    assert np.mean(off < 2.0 * pixel) > 0.93
    for a, b in ((other.surface.seen, ours.surface.seen), (other.lit.readings, ours.lit.readings)):
        assert a.shape == b.shape
        assert np.mean(a == b) > 0.9
    assert other.sketches.maps.astype(float) == pytest.approx(ours.sketches.maps, abs=16)


def test_the_commands_start_without_pyrender_and_opengl():
    """They are imported by the processes that draw, when they draw."""
    program = (
        "import sys, rendezview_ground.learn.command; "
        "import rendezview_ground.simulate.command, "
        "rendezview_ground.evaluate.demo_command; print({'pyrender', 'OpenGL'} & set(sys.modules))"
    )
    done = python("-c", program)
    assert (done.stdout, done.returncode) == ("set()\n", 0), done.stderr


def test_where_opengl_is_missing_one_line_says_so_and_ours_draws(monkeypatch, bumpy_mesh):
    monkeypatch.setenv("PYOPENGL_PLATFORM", "none")
    lines: list[str] = []
    assert working_renderer(Renderer.PYRENDER, bumpy_mesh, lines.append) is Renderer.NUMBA
    (line,) = lines
    assert line.startswith("pyrender does not work here (none: ")
    assert "--renderer numba" in line
    with pytest.raises(RendezviewError, match="pyrender does not work here"):
        PyrenderRenderer(bumpy_mesh).draw(some_poses(1)[0], WINDOW)


def test_the_command_falls_back_and_trains_with_ours(monkeypatch, capsys, bumpy_mesh, tmp_path):
    monkeypatch.setenv("PYOPENGL_PLATFORM", "none")
    trimesh.Trimesh(bumpy_mesh.vertices_m, bumpy_mesh.faces).export(tmp_path / "bumpy.stl")
    line = (
        f"rendezview train {tmp_path}/bumpy.stl --unit m -o {tmp_path}/bumpy.rvm "
        "--renderer pyrender --order 0 --held-out 0 --paper --jobs 1"
    )
    monkeypatch.setattr(sys, "argv", line.split())
    with pytest.raises(SystemExit, match="0"):
        main()
    said = capsys.readouterr().err
    assert said.count("pyrender does not work here") == 1
    assert "rendezview[training]" in said
    model = ViewModel.load(tmp_path / "bumpy.rvm")
    assert model.provenance["options"]["renderer"] == "numba"
