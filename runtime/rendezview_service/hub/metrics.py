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
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)

        def gauge(name: str, text: str, *labels: str) -> Gauge:
            return Gauge(f"rendezview_{name}", text, labels, registry=self._registry)

        def counter(name: str, text: str, *labels: str) -> Counter:
            return Counter(f"rendezview_{name}", text, labels, registry=self._registry)

        def seconds(name: str, text: str) -> Histogram:
            name, labels = f"rendezview_{name}_seconds", ["session"]
            return Histogram(name, text, labels, buckets=_BUCKETS_S, registry=self._registry)

        self.faults = gauge("faults", "Reasons in /healthz; 0: all is well.")
        self._used = gauge("budget_used", "In use of a budget.", "budget")
        self._most = gauge("budget_most", "What a budget allows.", "budget")
        gauge("unix_seconds", "The service's clock.").set_function(time.time)
        self.sessions = gauge("sessions", "Sessions.")
        self.watchers = gauge("watchers", "Watchers.")
        self.restarts = counter("worker_restarts", "Workers restarted.")
        self.requests = counter("requests", "Requests by status.", "status")
        # Of sessions
        self._frames = counter("frames", "Frames tracked.", "session", "status")
        self._drops = counter("frames_dropped", "Frames replaced by newer ones.", "session")
        self._refused = counter("frames_refused", "Frames that could not be read.", "session")
        self._latency = seconds("latency", "Time from a frame's arrival to its state.")
        self._track = seconds("track", "Time of the tracker without waiting and transport.")
        self._log = {
            name: gauge(f"log_{name}", text, "session")
            for name, text in (
                ("bytes", "Size of a session's log."),
                ("failed", "1 while a log cannot be written."),
                ("lost_states", "States in no file."),
                ("pending_states", "States that wait for the disk."),
                ("faults", "Faults of a log's files."),
            )
        }
        lines = "Lines of other sensors; outcome: accepted, other."
        self._lines = counter("measurements", lines, "session", "sensor", "outcome")

    def text(self, budgets: Mapping[str, BudgetUse]) -> bytes:
        """Prometheus text format."""
        for name, budget in budgets.items():
            self._used.labels(name).set(budget.used)
            self._most.labels(name).set(budget.most)
        return generate_latest(self._registry)

    # Of a session, by its name

    def begin(self, session: str) -> None:
        """A session begins."""
        for metric in (self._drops, self._refused, self._latency, self._track):
            metric.labels(session)

    def dropped(self, session: str) -> None:
        """A newer frame replaced one."""
        self._drops.labels(session).inc()

    def refused(self, session: str) -> None:
        """A frame could not be read."""
        self._refused.labels(session).inc()

    def tracked(self, session: str, status: str, track_ms: float, latency_s: float) -> None:
        """A frame was tracked."""
        self._frames.labels(session, status).inc()
        self._latency.labels(session).observe(latency_s)
        self._track.labels(session).observe(1e-3 * track_ms)

    def measured(self, session: str, sensor: str, lines: int, accepted: int) -> None:
        """Lines of another sensor were taken."""
        self._lines.labels(session, sensor, "accepted").inc(accepted)
        self._lines.labels(session, sensor, "other").inc(lines - accepted)

    def recording(self, session: str, now: Recording) -> None:
        """The state of the log."""
        failed = now.state is RecordingState.FAILED
        numbers = now.size_bytes, failed, now.lost, now.pending, now.faults
        for metric, number in zip(self._log.values(), numbers, strict=True):
            metric.labels(session).set(number)

    def end(self, session: str) -> None:
        """Forget a session."""
        one = self._frames, self._drops, self._refused, self._latency, self._track, self._lines
        for metric in (*one, *self._log.values()):
            metric.remove_by_labels({"session": session})
