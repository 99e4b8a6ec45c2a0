"""What a node tells about itself: counts, rates and durations on /diagnostics, and throttled warnings."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from ngo_estimator.nodes.messages import to_time

_QUIET_S = 5.0
"""Least time between two warnings of one kind."""


class NodeStatus:
    """Counts what a node takes and drops, and publishes it once a period.

    The period is one of real time, so that a silent input shows; the stamp is that of the newest input.
    """

    def __init__(self, node: Node, topic: str, period_s: float, details: Callable[[], dict[str, str]]) -> None:
        """Publish on ``topic`` every ``period_s``; ``details`` adds the node's own values."""
        self._node = node
        self._details = details
        self._totals: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._warned_at: dict[str, float] = {}
        self._unsaid: Counter[str] = Counter()
        self._newest_ns = 0
        self._start_period()
        self._publisher = node.create_publisher(DiagnosticArray, topic, 10)
        node.create_timer(period_s, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _start_period(self) -> None:
        self._since = time.perf_counter()
        self._received = self._dropped_now = 0
        self._durations_s: list[float] = []

    def received(self, stamp_ns: int) -> None:
        """Count one good input."""
        self._newest_ns = stamp_ns
        self._received += 1
        self._totals["received"] += 1

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Measure the node's main computation."""
        started = time.perf_counter()
        yield
        self._durations_s.append(time.perf_counter() - started)

    def dropped(self, kind: str, reason: object, count: int = 1) -> None:
        """Count ``count`` inputs as dropped, and warn: at once, then at most every few seconds a kind."""
        self._dropped[kind] += count
        self._dropped_now += count
        now = time.perf_counter()
        if now - self._warned_at.get(kind, -_QUIET_S) < _QUIET_S:
            self._unsaid[kind] += count
            return
        self._warned_at[kind] = now
        more = f" ({self._unsaid.pop(kind)} more before this one)" if self._unsaid[kind] else ""
        self._node.get_logger().warning(f"dropped {kind}: {reason}{more}")

    def _publish(self) -> None:
        elapsed_s = time.perf_counter() - self._since
        values = {
            "input rate (Hz)": f"{self._received / elapsed_s:.1f}",
            "received": str(self._totals["received"]),
            "dropped": str(self._dropped.total()),
            **{f"dropped: {kind}": str(count) for kind, count in sorted(self._dropped.items())},
        }
        if self._durations_s:
            mean_s = sum(self._durations_s) / len(self._durations_s)
            values["time an update, mean (ms)"] = f"{1e3 * mean_s:.2f}"
            values["time an update, max (ms)"] = f"{1e3 * max(self._durations_s):.2f}"
        level, message = DiagnosticStatus.OK, "running"
        if self._dropped_now:
            level, message = DiagnosticStatus.WARN, f"{self._dropped_now} inputs dropped in {elapsed_s:.1f} s"
        elif not self._received:
            level, message = DiagnosticStatus.STALE, f"no input for {elapsed_s:.1f} s"
        status = DiagnosticStatus(level=level, name=self._node.get_fully_qualified_name(), message=message)
        status.values = [KeyValue(key=key, value=value) for key, value in {**values, **self._details()}.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = to_time(self._newest_ns)
        self._publisher.publish(array)
        self._start_period()
