"""Short flights: 2 m before the client's port, with modelled readings."""

from __future__ import annotations

import pytest

from rendezview.io.bundled import find_target
from rendezview_ground.fly.options import ChaserOptions, FlyPlan, GuidanceOptions
from rendezview_ground.fly.setup import Setup
from rendezview_ground.mesh.mesh import load_mesh


def short_plan(start_m: float = 3.0, longest_s: float = 150.0) -> FlyPlan:
    return FlyPlan(
        chaser=ChaserOptions(start_m=start_m, place_sigma_m=0.02),
        guidance=GuidanceOptions(holds_m=(start_m - 1.0,), longest_s=longest_s),
    )


@pytest.fixture(scope="session")
def setup() -> Setup:
    target = find_target("client")
    return Setup.of(target, load_mesh(target.mesh_path, target.unit), short_plan())
