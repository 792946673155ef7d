"""Training from a target's path or name, as one function."""

from __future__ import annotations

from pathlib import Path

from rendezview.geometry.camera import Camera
from rendezview.io.bundled import find_target
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview.training import job
from rendezview.training.mesh import load_mesh
from rendezview.training.options import TrainingOptions
from rendezview.training.stages import Progress
from rendezview.training.symmetries import find_symmetries


def train(
    target: str | Path | Target,
    output: str | Path,
    *,
    unit: str | None = None,
    options: TrainingOptions | None = None,
    camera: Camera | None = None,
    jobs: int = -1,
    progress: Progress | None = None,
) -> ViewModel:
    """Train a view model of a target and write it to a file.

    Args:
        target: a mesh, a ``target.toml`` or its folder, or a vehicle that comes with rendezview.
        output: of the model, ``*.rvm``.
        unit: of a bare mesh: mm, cm, m, inch, foot.
        options: of the training; the defaults take a few minutes on two cores.
        camera: the flight camera; sets the sphere radius and the sharpness of the views.
        jobs: parallel jobs; -1 for all cores.
        progress: called with stage, done, total.

    Raises:
        RendezviewError: no such target, no usable mesh, or the file cannot be written.
    """
    found = target if isinstance(target, Target) else find_target(str(target))
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    trained = job.train(
        mesh,
        Path(output),
        name=found.name,
        options=options,
        camera=camera,
        symmetries=found.symmetries or find_symmetries(mesh),
        shape_error=found.shape_error,
        jobs=jobs,
        progress=progress,
    )
    return trained.model
