"""Training of a target with joints: a model of every configuration, in one file."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.geometry.joint import Joint
from rendezview.io.file_lock import FolderLock
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview_ground.learn.job import Trained, kept_model, provenance, train
from rendezview_ground.learn.jobs.stages import Progress
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.mesh.joints import (
    STEP_RAD,
    common_sphere,
    configuration_angles,
    model_of_configurations,
    posed,
)
from rendezview_ground.mesh.mesh import Mesh


def train_configurations(
    mesh: Mesh,
    path: Path,
    joints: Sequence[Joint],
    *,
    step_rad: float = STEP_RAD,
    progress: Progress | None = None,
    **arguments: Any,
) -> Trained:
    """Train a target with joints and write one model to ``path``.

    Finished configurations are kept in ``path`` + ``.sheets`` until the model is written.

    Args:
        mesh: of ``with_parts``.
        path: the model file to write.
        joints: of the target, in the order of the mesh's parts.
        step_rad: between configurations, at most.
        progress: called with the stage (and the configuration's number), the shards done
            and all shards.
        arguments: name, options, camera and so on, of ``train``.

    Raises:
        RendezviewError: as ``train``; there are too many configurations.
    """
    angles = configuration_angles(joints, step_rad)
    sphere = common_sphere(mesh, joints)
    options, camera = arguments.get("options"), arguments.get("camera")
    stated = {k: v for k, v in arguments.items() if k in ViewModel.__dataclass_fields__}
    stated |= {"centre_m": sphere[0], "target_radius_m": sphere[1]}
    folder = path.with_name(path.name + ".sheets")
    if not path.parent.is_dir():
        raise RendezviewError(f"{path}: give a file name in an existing folder for the model")
    configurations, first = [], None
    with FolderLock(folder, path):  # until the model is written
        for k, own in enumerate(angles):
            configuration = posed(mesh, joints, own)
            file = folder / f"{k:02d}.rvm"

            def tell(stage: str, done: int, of: int, number: int = k + 1) -> None:
                if progress is not None:
                    progress(f"{stage} {number}/{len(angles)}", done, of)

            made = provenance(configuration, options or TrainingOptions(), camera)
            kept = kept_model(file, made, stated)
            if kept is None:
                trained = train(
                    configuration, file, bounding_sphere=sphere, progress=tell, **arguments
                )
                first, kept = first or trained, trained.model
            configurations.append(kept)
        model = model_of_configurations(configurations, joints, angles)
        model.save(path)
        shutil.rmtree(folder, ignore_errors=True)
    if first is None:
        geometry = view_geometry(mesh, options or TrainingOptions(), camera, sphere)
        return Trained(model, None, geometry)
    return replace(first, model=model)
