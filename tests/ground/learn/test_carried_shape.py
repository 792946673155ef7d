"""The light mesh that a model carries: what can be seen of the target, and no more."""

from __future__ import annotations

import numpy as np
import trimesh

from rendezview.sensors.appearance.model.shape import Shape
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.carried_shape import carried_shape
from rendezview_ground.mesh.mesh import Mesh


def shape_of(*bodies: trimesh.Trimesh) -> Shape:
    body = trimesh.util.concatenate(bodies)
    assert isinstance(body, trimesh.Trimesh)
    grey = np.full((len(body.faces), 3), 0.5, np.float32)
    mesh = Mesh(np.asarray(body.vertices), body.faces.astype(np.int32), grey, ())
    return carried_shape(mesh, view_geometry(mesh, TrainingOptions(), None), seed=0)


def test_what_lies_within_a_craft_is_not_carried():
    outer, inner = trimesh.creation.box((2.0, 1.5, 1.0)), trimesh.creation.icosphere(2, 0.3)
    shape = shape_of(outer, inner)
    assert len(shape.faces) == len(shape.albedo) == 12
    assert len(shape.vertices_m) == 8
    assert np.linalg.norm(shape.vertices_m, axis=1).min() > 1.0


def test_what_is_seen_through_an_opening_is_carried():
    box, inner = trimesh.creation.box((2.0, 1.5, 1.0)), trimesh.creation.icosphere(2, 0.3)
    above = box.triangles_center[:, 2] > 0.49
    box.update_faces(~above)
    shape = shape_of(box, inner)
    assert 10 < len(shape.faces) < len(box.faces) + len(inner.faces)
    upper = np.linalg.norm(shape.vertices_m - shape.vertices_m[:8].mean(0), axis=1)
    assert (upper < 0.8).sum() > 40  # vertices of the ball
