"""Diagnostics of a node: counts, rates and durations on /diagnostics, and throttled warnings."""

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from ngo_common.nodes.name_watch import NameWatch
from ngo_common.nodes.qos import overridable
from ngo_estimator.nodes.messages import to_time
from ngo_estimator.nodes.settings import StepSettings

_QUIET_S = 5.0  # Least time between two warnings of one kind.


class NodeStatus:
    """Counts the inputs that a node takes and drops, and publishes the counts once a period.

    The period is one of real time, so that a silent input shows; the stamp is that of the newest input.
    """

    def __init__(
        self,
        node: Node,
        settings: StepSettings,
        details: Callable[[], dict[str, str]],
        problems: Callable[[], list[str]] = list,
    ) -> None:
        """Publish as the settings say; ``details`` adds the node's own values, ``problems`` lines."""
        self._node = node
        self._details, self._problems = details, problems
        self._name_watch = NameWatch(node)
        self._totals: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._warned_at: dict[str, float] = {}
        self._unsaid: Counter[str] = Counter()
        self._newest_ns = 0
        self.idle = ""
        """Why no input is expected now; empty: input is expected."""
        self._start_period()
        self._publisher = node.create_publisher(
            DiagnosticArray, settings.diagnostics_topic, 10, qos_overriding_options=overridable()
        )
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(settings.diagnostics_period_s, self._publish, clock=clock)

    def close(self) -> None:
        """Publish no more."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def set_period(self, period_s: float) -> None:
        """Publish every ``period_s`` from now on."""
        self._timer.timer_period_ns = int(period_s * 1e9)

    def _start_period(self) -> None:
        self._since = time.perf_counter()
        self._received = self._dropped_now = 0
        self._durations_s: dict[str, list[float]] = {}

    def received(self, stamp_ns: int) -> None:
        """Count one good input."""
        self._newest_ns = stamp_ns
        self._received += 1
        self._totals["received"] += 1

    def took(self, what: str, seconds: float) -> None:
        """Count how long something took, for mean and maximum."""
        self._durations_s.setdefault(what, []).append(seconds)

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """Measure the duration of the block, unless it fails."""
        started = time.perf_counter()
        yield
        self.took(what, time.perf_counter() - started)

    def dropped(self, kind: str, reason: object, count: int = 1, warn: bool = True) -> None:
        """Count ``count`` inputs as dropped, and warn: at once, then at most every few seconds a kind and reason.

        They are counted by ``kind``, and by the name of ``reason`` if it is an error class of its own. Without ``warn``
        they are counted only.
        """
        key = kind + _short(reason)
        self._dropped[key] += count
        self._dropped_now += count
        now = time.perf_counter()
        if not warn or now - self._warned_at.get(key, -_QUIET_S) < _QUIET_S:
            self._unsaid[key] += count
            return
        self._warned_at[key] = now
        more = f" ({self._unsaid.pop(key)} more before this one)" if self._unsaid[key] else ""
        self._node.get_logger().warning(f"dropped {kind}: {reason}{more}")

    def _publish(self) -> None:
        elapsed_s = time.perf_counter() - self._since
        values = {
            "input rate (Hz)": f"{self._received / elapsed_s:.1f}",
            "received": str(self._totals["received"]),
            "dropped": str(self._dropped.total()),
            **{f"dropped: {key}": str(count) for key, count in sorted(self._dropped.items())},
        }
        for what, durations_s in self._durations_s.items():
            values[f"{what}, mean (ms)"] = f"{1e3 * sum(durations_s) / len(durations_s):.2f}"
            values[f"{what}, max (ms)"] = f"{1e3 * max(durations_s):.2f}"
        problems = self._problems()
        if namesake := self._name_watch.look():
            problems.append(namesake)
        if self._dropped_now:
            problems.append(f"{self._dropped_now} inputs dropped in {elapsed_s:.1f} s")
        level, message = DiagnosticStatus.OK, self.idle or "running"
        if problems:
            level, message = DiagnosticStatus.WARN, "; ".join(problems)
        elif not self._received and not self.idle:
            level, message = DiagnosticStatus.STALE, f"no input for {elapsed_s:.1f} s"
        status = DiagnosticStatus(level=level, name=self._node.get_fully_qualified_name(), message=message)
        status.values = [KeyValue(key=key, value=value) for key, value in {**values, **self._details()}.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = to_time(self._newest_ns)
        self._publisher.publish(array)
        self._start_period()


def _short(reason: object) -> str:
    """The name of an error's class in words, in brackets: `` (late frame)`` of ``LateFrame``."""
    if not isinstance(reason, ValueError) or type(reason) is ValueError:
        return ""
    return f" ({re.sub('(?<!^)(?=[A-Z])', ' ', type(reason).__name__).lower()})"
