"""Prometheus metrics of the service."""

from __future__ import annotations

import time
from collections.abc import Mapping

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)

from rendezview_service.messages.message_parts import BudgetUse
from rendezview_service.messages.messages import Recording, RecordingState

# s. Source: chosen.
_BUCKETS_S = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


class Metrics:
    """All metrics, in their own registry."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self.faults = Gauge(
            "rendezview_faults", "Reasons in /healthz; 0: all is well.", registry=self.registry
        )
        self._used, self._most = (
            Gauge(f"rendezview_budget_{name}", text, ["budget"], registry=self.registry)
            for name, text in (("used", "In use of a budget."), ("most", "What a budget allows."))
        )
        clock = Gauge("rendezview_unix_seconds", "The service's clock.", registry=self.registry)
        clock.set_function(time.time)
        one = ["session"]
        self.frames = Counter(
            "rendezview_frames", "Frames tracked.", ["session", "status"], registry=self.registry
        )
        self.drops = Counter(
            "rendezview_frames_dropped",
            "Frames replaced by newer ones.",
            one,
            registry=self.registry,
        )
        self.refused = Counter(
            "rendezview_frames_refused",
            "Frames that could not be read.",
            one,
            registry=self.registry,
        )
        self.latency = Histogram(
            "rendezview_latency_seconds",
            "Time from a frame's arrival to its state.",
            one,
            buckets=_BUCKETS_S,
            registry=self.registry,
        )
        self.track = Histogram(
            "rendezview_track_seconds",
            "Time of the tracker without waiting and transport.",
            one,
            buckets=_BUCKETS_S,
            registry=self.registry,
        )
        self.log_bytes = Gauge(
            "rendezview_log_bytes", "Size of a session's log.", one, registry=self.registry
        )
        self.log_failed = Gauge(
            "rendezview_log_failed", "1 while a log cannot be written.", one, registry=self.registry
        )
        self.log_lost = Gauge(
            "rendezview_log_lost_states", "States in no file.", one, registry=self.registry
        )
        self.log_pending = Gauge(
            "rendezview_log_pending_states",
            "States that wait for the disk.",
            one,
            registry=self.registry,
        )
        self.log_faults = Gauge(
            "rendezview_log_faults", "Faults of a log's files.", one, registry=self.registry
        )
        self.measurements = Counter(
            "rendezview_measurements",
            "Lines of other sensors; outcome: accepted, other.",
            ["session", "sensor", "outcome"],
            registry=self.registry,
        )
        self.sessions = Gauge("rendezview_sessions", "Sessions.", registry=self.registry)
        self.watchers = Gauge("rendezview_watchers", "Watchers.", registry=self.registry)
        self.restarts = Counter(
            "rendezview_worker_restarts", "Workers restarted.", registry=self.registry
        )
        self.requests = Counter(
            "rendezview_requests", "Requests by status.", ["status"], registry=self.registry
        )

    def of_session(self, name: str) -> SessionMetrics:
        """The metrics of one session."""
        return SessionMetrics(self, name)

    def text(self, budgets: Mapping[str, BudgetUse]) -> bytes:
        """Prometheus text format."""
        for name, budget in budgets.items():
            self._used.labels(name).set(budget.used)
            self._most.labels(name).set(budget.most)
        return generate_latest(self.registry)


class SessionMetrics:
    """Metrics of one session, removed with it."""

    def __init__(self, all_of_them: Metrics, name: str) -> None:
        self._all, self._name = all_of_them, name
        self.drops = all_of_them.drops.labels(name)
        self.refused = all_of_them.refused.labels(name)
        self._latency = all_of_them.latency.labels(name)
        self._track = all_of_them.track.labels(name)
        self._frames: dict[str, Counter] = {}
        self._sensors: set[tuple[str, str]] = set()

    def tracked(self, status: str, track_ms: float, latency_s: float) -> None:
        """A frame was tracked."""
        if status not in self._frames:
            self._frames[status] = self._all.frames.labels(self._name, status)
        self._frames[status].inc()
        self._latency.observe(latency_s)
        self._track.observe(1e-3 * track_ms)

    def measured(self, sensor: str, lines: int, accepted: int) -> None:
        """Lines of another sensor were taken."""
        for outcome, count in (("accepted", accepted), ("other", lines - accepted)):
            self._all.measurements.labels(self._name, sensor, outcome).inc(count)
            self._sensors.add((sensor, outcome))

    def recording(self, now: Recording) -> None:
        """The state of the log."""
        self._all.log_bytes.labels(self._name).set(now.size_bytes)
        self._all.log_failed.labels(self._name).set(now.state is RecordingState.FAILED)
        self._all.log_lost.labels(self._name).set(now.lost)
        self._all.log_pending.labels(self._name).set(now.pending)
        self._all.log_faults.labels(self._name).set(now.faults)

    def remove(self) -> None:
        """Forget the session."""
        for status in self._frames:
            self._all.frames.remove(self._name, status)
        for sensor, outcome in self._sensors:
            self._all.measurements.remove(self._name, sensor, outcome)
        every = (
            self._all.drops, self._all.refused, self._all.latency, self._all.track,
            self._all.log_bytes, self._all.log_failed, self._all.log_lost,
            self._all.log_pending, self._all.log_faults,
        )  # fmt: skip
        for metric in every:
            metric.remove(self._name)  # no error if there is none
