"""What several tests share: an asymmetric body, a camera, drawn frames and a small model."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from tests.compiled import compile_for_tests
from tests.evidence import matrix, requirements
from tests.ground.mesh.mesh_samples import boxes, grey_mesh
from tests.left_behind import none_left_behind
from tests.made_once import made_once
from tests.quick_training import REFINING

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.beacons import Rig, Spots
from rendezview_ground.learn.job import train
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import Window
from rendezview_ground.render.rasterizer import NumbaRenderer
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions

# The same examples in every run, however slow the machine is.
settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("repeatable")

SERVICE, PAGES = "tests/service/", "tests/service/test_page"
# Begun last, they would be what all others wait for.
LONG = (
    "tests/ground/learn/test_cluster.py",
    "tests/ground/mesh/test_public_meshes.py",
    "tests/ground/render/test_pyrender.py",
    "tests/cli/test_whole_approach.py",
)
Draw = Callable[..., np.ndarray]

BUMPS_M = [  # size, place: no rotation and no mirror maps this body to itself
    ((2.0, 1.2, 0.8), (0.0, 0.0, 0.0)),
    ((0.5, 0.5, 0.9), (0.9, 0.5, 0.5)),
    ((1.4, 0.25, 0.25), (-1.2, -0.4, 0.3)),
    ((0.3, 1.0, 0.3), (0.3, -0.9, -0.3)),
]


# Compiling makes millions of small objects that live on: looking through them again and again takes
# a tenth of the tests' time.
gc.freeze()
gc.set_threshold(200_000, 50, 100)


def pytest_configure(config: pytest.Config) -> None:
    """Of several workers none compiles a listed loop that another one compiles too."""
    workers = 0 if hasattr(config, "workerinput") else getattr(config.option, "numprocesses", None)
    if workers:
        compile_for_tests()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Files go to the worker that is free, in their order; the service's stay together.

    So do those of its pages.
    """
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            # They share services, models and a browser. With more workers they would be what all
            # others wait for.
            if self.numnodes <= 4 and nodeid.startswith(SERVICE):
                return PAGES if nodeid.startswith(PAGES) else SERVICE
            return super()._split_scope(nodeid)

    config.option.loadscopereorder = False  # else files with few tests come last: the slow ones
    return Scheduling(config, log)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores, for the tests that wait; each collects all tests first."""
    return 1 + (os.cpu_count() or 1)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Of several workers one begins with the service's tests: they take a third of the time."""

    def turn(item: pytest.Item) -> int:
        if item.nodeid.startswith(SERVICE):
            return int(item.nodeid.startswith(PAGES))
        return 2 if item.nodeid.startswith(LONG) else 3

    if hasattr(config, "workerinput"):
        items.sort(key=turn)
    for item in items:  # for --evidence
        for marker in item.iter_markers("requirement"):
            item.user_properties += [("requirement", name) for name in marker.args]


def pytest_addoption(parser: pytest.Parser) -> None:
    said = "print every requirement with the results of its tests; fail where one does not hold"
    parser.addoption("--evidence", action="store_true", help=said)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Of all workers together: those have no reporter."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if session.config.option.evidence and reporter is not None:
        lines, faults = matrix(reporter.stats, requirements())
        print(*["", *lines, *faults], sep="\n")
        if faults and not session.exitstatus:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session", autouse=True)
def no_process_is_left_behind() -> Iterator[None]:
    """Set up before all others of the session, it ends after them."""
    with none_left_behind():
        yield


@pytest.fixture(scope="session")
def bumpy_mesh() -> Mesh:
    return grey_mesh(boxes(BUMPS_M))


@pytest.fixture(scope="session")
def camera() -> Camera:
    return Camera.from_fov(400, 400, np.deg2rad(40.0))


@pytest.fixture(scope="session")
def tiny_options() -> TrainingOptions:
    return TrainingOptions(
        order=2,
        bins=120,
        smooth_bins=5,
        resolution_px=128,
        perturbed_views=800,
        held_out_views=150,
        contour_points=0,
        shadowed_silhouettes=False,
    )


@pytest.fixture(scope="session")
def refining_model(tmp_path_factory: pytest.TempPathFactory, bumpy_mesh: Mesh) -> ViewModel:
    """The bumpy body with contour points and lit silhouettes, and next to no trees."""

    def trained(path: Path) -> None:
        train(bumpy_mesh, path, name="bumpy", options=REFINING, jobs=1)

    return ViewModel.load(made_once(tmp_path_factory, "refining.rvm", trained))


@pytest.fixture(scope="session")
def tiny_model_path(
    tmp_path_factory: pytest.TempPathFactory, bumpy_mesh: Mesh, tiny_options: TrainingOptions
) -> Path:
    def trained(path: Path) -> None:
        train(bumpy_mesh, path, name="bumpy", options=tiny_options, jobs=1)

    return made_once(tmp_path_factory, "bumpy.rvm", trained)


@pytest.fixture(scope="session")
def tiny_model(tiny_model_path: Path) -> ViewModel:
    return ViewModel.load(tiny_model_path)


@pytest.fixture(scope="session")
def draw() -> Draw:
    """Frames (H, W) uint8 of a mesh as a camera has them; noiseless where no rng is given."""

    def frame_of(
        mesh: Mesh,
        pose: Pose,
        camera: Camera,
        rng: np.random.Generator | None = None,
        noise_grey: float = 3.0,
        bright_grey: float = 140.0,
    ) -> np.ndarray:
        assert camera.fx == camera.fy
        assert not camera.is_distorted
        cx, cy = 4 * (camera.cx + 0.5) - 0.5, 4 * (camera.cy + 0.5) - 0.5
        window = Window(4 * camera.width, 4 * camera.height, 4 * camera.fx, cx, cy)
        fine = NumbaRenderer(mesh).draw(pose, window)
        cover = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        frame = 12.0 + cv2.GaussianBlur(cover, (0, 0), 0.7) * (bright_grey / 255.0)
        if rng is not None:
            frame = frame + rng.normal(0.0, noise_grey, frame.shape)
        return np.clip(np.rint(frame), 0, 255).astype(np.uint8)

    return frame_of


@pytest.fixture(scope="session")
def scole() -> Target:
    return find_target("scole")


@pytest.fixture(scope="session")
def leds(scole: Target) -> np.ndarray:
    return np.array([led.position_m for led in scole.leds])


@pytest.fixture(scope="session")
def laboratory(leds: np.ndarray) -> Laboratory:
    """Perfect lens and detectors, so that its own rig reads it without bias."""
    return Laboratory(leds, LaboratoryOptions(distorted=False), seed=1)


@pytest.fixture(scope="session")
def read():
    """Currents (C, L, 4) of one reading → spots of each camera."""

    def of(rig: Rig, currents: np.ndarray) -> list[Spots]:
        return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]

    return of
