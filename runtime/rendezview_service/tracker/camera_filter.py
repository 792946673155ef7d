"""The filter of a session with a camera only: rates, and a prediction while it coasts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rendezview.fusion import Fusion, FusionOptions, Measurement, PoseMeasurement
from rendezview_service.messages.fusion_messages import FusionRequest
from rendezview_service.tracker.sensor_lines import Json
from rendezview_service.tracker.session_filter import SensorCounts, SessionFilter

# σ of first rates of which nothing is known: a tumbling target, a fast fly-by. Source: chosen.
_ANY_RAD_S, _ANY_M_S = 0.5, 10.0
# The same until the second pose, so that the filter can still use it. Source: below the limits at
# which `fusion.step` starts again, 1 rad and the range.
_ANY_RAD, _ANY_RANGES = 0.5, 0.4
# Poses in a row that contradict the filter grossly, after which it starts again: squared deviations
# in σ, where the filter's own gate is about 20. Source: chosen.
_REJECTIONS, _GROSS_NIS = 3, 200.0


class CameraFilter(SessionFilter):
    """Runs from the first pose. Without options, the first two poses give the rates."""

    def __init__(self, request: FusionRequest | None) -> None:
        """A filter with the options of a request, if it has any."""
        super().__init__(request)
        self._keeps_options = request is not None and request.options is not None
        self._knows_rates = self._keeps_options
        self._rejected = 0  # poses in a row
        self._first: PoseMeasurement | None = None
        self._start(None)

    def _add(self, measurement: Measurement, counts: SensorCounts) -> Json:
        if not self._knows_rates and isinstance(measurement, PoseMeasurement):
            first, self._first = self._first, measurement
            if first is not None and measurement.time_s > first.time_s:
                self._knows_rates = True
                self._fusion = Fusion(self._with_any_rates(first, measurement))
                self._fusion.add(first)
        verdict = super()._add(measurement, counts)
        gross = verdict["nis"] is None or verdict["nis"] > _GROSS_NIS
        self._rejected = self._rejected + 1 if gross and not verdict["accepted"] else 0
        if self._rejected < _REJECTIONS or not isinstance(measurement, PoseMeasurement):
            return verdict
        # No other sensor can say who is right, and poses in a row do not err alike.
        self._start(f"{_REJECTIONS} poses in a row contradicted it")
        self._knows_rates, self._first, self._rejected = self._keeps_options, measurement, 0
        return super()._add(measurement, counts)

    def _with_any_rates(self, first: PoseMeasurement, second: PoseMeasurement) -> FusionOptions:
        gap_s = second.time_s - first.time_s
        range_m = float(np.linalg.norm(first.pose.translation_m))
        motion = replace(
            self._options.motion,
            first_rate=min(_ANY_RAD_S, _ANY_RAD / gap_s),
            first_velocity=min(_ANY_M_S, _ANY_RANGES * range_m / gap_s),
        )
        self._options = replace(self._options, motion=motion)
        return self._options
