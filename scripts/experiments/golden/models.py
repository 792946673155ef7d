"""Models of the golden file: trained quickly, small, the same bytes every time."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.golden.answers import Answers
from rendezview import Target, TrainingOptions, ViewModel, load_mesh
from rendezview.export.c_code import write_c
from rendezview.sensors.appearance.model.container import read_container
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.mesh.mesh import Mesh

QUICK = TrainingOptions(
    order=2, bins=120, smooth_bins=3, resolution_px=160, perturbed_views=1500, held_out_views=100,
    contour_radii=(1.0, 2.0), contour_resolution_px=256, surface_points=2048,
)  # fmt: skip
SMALLEST = replace(QUICK, order=1, perturbed_views=400)  # of each angle of a target with joints
_STEP_RAD = float(np.deg2rad(90.0))  # between these angles


def trained(path: Path, source: Path, unit: str | None = None) -> tuple[Mesh, ViewModel]:
    """Mesh and model of a target; the model is trained where its file is not there."""
    target = Target.load(source)
    mesh = load_mesh(target.mesh_path, unit or target.unit)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        more = {"step_rad": _STEP_RAD, "options": SMALLEST} if target.joints else {"options": QUICK}
        train_target(target, mesh, path, unit, jobs=1, **more)
    return mesh, ViewModel.load(path)


def digests(answers: Answers, path: Path, model: ViewModel, code: Path) -> None:
    """Of a model's file, of its arrays without the versions of the header, and of its C code."""
    hashes = {name: hashlib.sha256() for name in ("file", "arrays", "flight code")}
    hashes["file"].update(path.read_bytes())
    for key, array in sorted(read_container(path)[1].items()):
        hashes["arrays"].update(f"{key} {array.dtype.str} {array.shape}".encode() + array.tobytes())
    for written in sorted(write_c(model, code)):
        hashes["flight code"].update(written.name.encode() + written.read_bytes())
    for name, sha256 in hashes.items():
        answers.add(f"model/{name}", f"{path.stem} {sha256.hexdigest()}")
