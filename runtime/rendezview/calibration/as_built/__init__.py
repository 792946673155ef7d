"""The shape of a target as it was built, estimated from frames."""

from rendezview.calibration.as_built.estimation import ShapeEstimator
from rendezview.calibration.as_built.shape import AsBuilt, ShapeOptions
from rendezview.calibration.as_built.strain import strain_names, strained

__all__ = ["AsBuilt", "ShapeEstimator", "ShapeOptions", "strain_names", "strained"]
