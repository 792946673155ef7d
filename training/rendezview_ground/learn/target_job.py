"""Training from a target's path or name, as one function."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rendezview.geometry.camera import Camera
from rendezview.io.bundled import find_target
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.learn import job
from rendezview_ground.learn.job import Trained
from rendezview_ground.learn.jobs.stages import Progress
from rendezview_ground.learn.joint_configurations import train_configurations
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.mesh.joints import STEP_RAD, configuration_angles, posed, with_parts
from rendezview_ground.mesh.mesh import Mesh, load_mesh
from rendezview_ground.mesh.parts import with_blankets, with_trust
from rendezview_ground.mesh.symmetries import find_symmetries


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
    return train_target(
        found, mesh, Path(output), unit, options=options, camera=camera, jobs=jobs,
        progress=progress,
    ).model  # fmt: skip


def train_target(
    target: Target, mesh: Mesh, output: Path, unit: str | None = None, **arguments: Any
) -> Trained:
    """Train a target whose mesh is loaded, with its joints if it has any.

    Args:
        target: gives name, symmetries, shape error, ring, reflectors and joints.
        mesh: of the target's file.
        output: the model file to write.
        unit: of a bare mesh.
        arguments: options, camera and so on, of ``job.train``; ``step_rad`` of
            ``train_configurations``.
    """
    step_rad = arguments.pop("step_rad", STEP_RAD)
    arguments |= _stated(target)
    whole, joints = _whole(target, mesh, unit), [parts.joint for parts in target.joints]
    if not joints:
        alike = target.symmetries or find_symmetries(whole)
        return job.train(whole, output, symmetries=alike, **arguments)
    return train_configurations(
        whole, output, joints, step_rad=step_rad, symmetries=target.symmetries, **arguments
    )


def is_trained(
    target: Target, mesh: Mesh, output: Path, unit: str | None, options: TrainingOptions,
    camera: Camera | None,
) -> bool:  # fmt: skip
    """Whether a file is the model that ``train_target`` would write."""
    first, joints = _whole(target, mesh, unit), tuple(parts.joint for parts in target.joints)
    if joints:
        first = posed(first, joints, configuration_angles(joints, STEP_RAD)[0])
    stated = _stated(target) | {"joints": joints}
    if target.symmetries:
        stated["symmetries"] = target.symmetries
    return job.kept_model(output, job.provenance(first, options, camera), stated) is not None


def _stated(target: Target) -> dict[str, Any]:
    """What a target's file says of its model beside the mesh, as ``job.train`` takes it."""
    names = ("name", "shape_error", "docking_ring", "reflectors")
    return {name: getattr(target, name) for name in names}


def _whole(target: Target, mesh: Mesh, unit: str | None) -> Mesh:
    """The mesh with the parts of joints, how far they are trusted, and blankets."""
    if target.joints:
        mesh = with_parts(mesh, target, unit)
    return with_blankets(with_trust(mesh, target, unit), target, unit)
