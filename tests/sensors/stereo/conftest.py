"""The laboratory that these tests share: SCOLE's lights, two photodiodes, known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rendezview.io.target import Target
from rendezview.sensors.stereo import Rig, Spots
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions

SCOLE = Path(__file__).resolve().parents[3] / "models_cad" / "scole"


@pytest.fixture(scope="session")
def scole() -> Target:
    return Target.load(SCOLE)


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
