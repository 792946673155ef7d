"""Models of an undisturbed training on one core, which other ways must equal byte for byte."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.made_once import made_once
from tests.quick_training import EVERY_STAGE, FEW_STAGES

from rendezview_ground.learn.job import train
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.mesh.mesh import Mesh


def _bytes(
    factory: pytest.TempPathFactory, name: str, mesh: Mesh, options: TrainingOptions
) -> bytes:
    def trained(path: Path) -> None:
        train(mesh, path, name="bumpy", options=options, jobs=1)
        assert not path.with_name(path.name + ".partial").exists()  # no shards stay

    return made_once(factory, name, trained).read_bytes()


@pytest.fixture(scope="session")
def every_stage(tmp_path_factory: pytest.TempPathFactory, bumpy_mesh: Mesh) -> bytes:
    return _bytes(tmp_path_factory, "every-stage.rvm", bumpy_mesh, EVERY_STAGE)


@pytest.fixture(scope="session")
def few_stages(tmp_path_factory: pytest.TempPathFactory, bumpy_mesh: Mesh) -> bytes:
    return _bytes(tmp_path_factory, "few-stages.rvm", bumpy_mesh, FEW_STAGES)
