"""The service as a process, and frames for it."""

from __future__ import annotations

import atexit
from pathlib import Path
from typing import Any

import numpy as np

from experiments.frame import tests_module
from rendezview import open_sequence


class Loop:
    """Frames of a scene to and fro, with times that rise."""

    def __init__(self, scene: Path) -> None:
        sequence = open_sequence(scene)
        self.camera = sequence.frames[0].camera
        self.prior = sequence.frames[0].camera_from_target
        images = [frame.read() for frame in sequence]
        self.images = images + images[-2:0:-1]

    def __call__(self, k: int) -> tuple[float, np.ndarray]:
        return k / 30.0, self.images[k % len(self.images)]


def serve(model: Path, *flags: str, **settings: object) -> Any:
    """`rendezview serve` as a process, ready; ``settings``: RENDEZVIEW_SERVE_…"""
    environment = {f"RENDEZVIEW_SERVE_{n.upper()}": str(value) for n, value in settings.items()}
    served = tests_module("service.served").Served.start(
        str(model), *flags, folder=Path(), environment=environment, most_lines=1000
    )
    atexit.register(lambda: served.process.poll() is None and served.kill())
    served.await_ready()
    return served
