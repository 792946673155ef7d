"""Models of the golden file: trained quickly, small, the same bytes every time."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.frame import MODELS_CAD
from experiments.golden.answers import Answers
from rendezview.export.c_code import write_c
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.container import read_container
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.mesh.mesh import Mesh, load_mesh

QUICK = TrainingOptions(
    order=2, bins=120, smooth_bins=3, resolution_px=160, perturbed_views=1500, held_out_views=100,
    contour_radii=(1.0, 2.0), contour_resolution_px=256, surface_points=2048,
)  # fmt: skip
SMALLEST = replace(QUICK, order=1, perturbed_views=400)  # of each angle of a target with joints
_STEP_RAD = float(np.deg2rad(90.0))  # between these angles


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A target with its mesh and model."""

    target: Target
    mesh: Mesh
    path: Path
    model: ViewModel


def trained(folder: Path, name: str, target: Path, unit: str | None = None) -> Trained:
    """The model in a folder; trained into it where it is not there."""
    found, path = Target.load(target), folder / f"{name}.rvm"
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        more = {"step_rad": _STEP_RAD, "options": SMALLEST} if found.joints else {"options": QUICK}
        train_target(found, mesh, path, unit, jobs=1, **more)
    return Trained(found, mesh, path, ViewModel.load(path))


def bundled(folder: Path) -> dict[str, Trained]:
    """Three vehicles."""
    return {
        name: trained(folder, name, MODELS_CAD / name) for name in ("hubble", "client", "shuttle")
    }


def digests(answers: Answers, models: dict[str, Trained], folder: Path) -> None:
    """Of each model file, of its arrays without the versions of the header, and of its C code."""
    for name, one in models.items():
        arrays, code = hashlib.sha256(), hashlib.sha256()
        for key, array in sorted(read_container(one.path)[1].items()):
            arrays.update(f"{key} {array.dtype.str} {array.shape}".encode() + array.tobytes())
        for path in sorted(write_c(one.model, folder / name)):
            code.update(path.name.encode() + path.read_bytes())
        whole = hashlib.sha256(one.path.read_bytes())
        for group, sha256 in (("files", whole), ("arrays", arrays), ("flight code", code)):
            answers.add(f"model {group}", f"{name} {sha256.hexdigest()}")
