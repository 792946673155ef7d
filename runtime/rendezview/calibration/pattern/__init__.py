"""Self-calibration of a pattern of reflectors: where they are, and which one is off."""

from rendezview.calibration.pattern.measure import MeasuredPattern, measure_pattern
from rendezview.calibration.pattern.sightings import (
    KnownLength,
    Sighting,
    loosened,
    sightings_of_log,
    sightings_of_readings,
)

__all__ = [
    "KnownLength",
    "MeasuredPattern",
    "Sighting",
    "loosened",
    "measure_pattern",
    "sightings_of_log",
    "sightings_of_readings",
]
