"""Real node processes for tests, and a probe that talks to them over DDS."""

import functools
import os
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

from demo.graph import NodeSpec

from .node_server import Forked, NodeServer

# Ample for a machine of its own; one that is shared may need more, and `--timeout` of pytest as well.
TIMEOUT_S = float(os.environ.get("NGO_TEST_TIMEOUT_S", "60"))

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_POLL_S = 0.02
_PYTHON_PATH = os.environ.get("PYTHONPATH")  # of the server: with another one a node imports other modules
_ASK_AGAIN_S = 0.3  # an answer to who is not known yet never comes

Result = TypeVar("Result")
node_server = functools.cache(NodeServer)


class NodeProcess:
    """One node as its own process; its output is in ``log``.

    It is a fork of the ``NodeServer``, or with ``fresh`` started as a user does, importing all by itself.
    """

    def __init__(
        self,
        package: str,
        executable: str,
        parameters: Mapping[str, Any] | None = None,
        ros_arguments: tuple[str, ...] = (),
        fresh: bool = False,
    ) -> None:
        self.name = executable
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115
        command = NodeSpec(package, executable, parameters or {}, ros_arguments).command()
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", "RCUTILS_LOGGING_USE_STDOUT": "0"}
        self._process: subprocess.Popen[bytes] | Forked
        if fresh or os.environ.get("PYTHONPATH") != _PYTHON_PATH:
            self._process = subprocess.Popen(command, stdout=self._log, stderr=subprocess.STDOUT, env=environment)
        else:
            log = self._log.fileno()
            self._process = node_server().start(command, environment, log, log)

    def __enter__(self) -> "NodeProcess":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.running:
            self._process.kill()
            self.wait()
        self._log.close()

    @property
    def log(self) -> str:
        """What it wrote so far, to stdout and stderr."""
        size = os.fstat(self._log.fileno()).st_size
        return os.pread(self._log.fileno(), size, 0).decode()

    @property
    def lines(self) -> list[str]:
        """The lines that it wrote, without those of the middleware about what other processes left behind."""
        return [line for line in self.log.splitlines() if line.strip() and "RTPS_" not in line]

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def children(self) -> list[int]:
        """Process ids of its own children."""
        tasks = Path(f"/proc/{self.pid}/task").iterdir()
        return [int(pid) for task in tasks for pid in (task / "children").read_text().split()]

    def send(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Wait for its end and return its exit code."""
        deadline = time.monotonic() + timeout_s
        while (code := self._process.poll()) is None:
            assert time.monotonic() < deadline, f"{self.name} did not end in {timeout_s:g} s; it wrote:\n{self.log}"
            time.sleep(_POLL_S)
        return code

    def wait_for_log(self, pattern: str, timeout_s: float = TIMEOUT_S) -> None:
        """Wait until it has written what ``pattern`` matches."""
        wait_until(
            lambda: re.search(pattern, self.log) or not self.running,
            f"'{pattern}' from {self.name}",
            timeout_s,
        )
        assert re.search(pattern, self.log), f"{self.name} ended without writing '{pattern}'; it wrote:\n{self.log}"


def end(*nodes: NodeProcess, by: signal.Signals = signal.SIGINT) -> None:
    """Send the signal to all of them at once; they end with code 0 and without a traceback."""
    for node in nodes:
        node.send(by)
    for node in nodes:
        assert node.wait() == 0, node.log
        assert "Traceback" not in node.log, node.log


def run_forked(
    command: list[str], timeout_s: float, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """What a Python program writes, as a fork of the ``NodeServer``, and its exit code."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        given = dict(os.environ if environment is None else environment)
        process = node_server().start(command, given, out.fileno(), errors.fileno())
        try:
            wait_until(lambda: process.poll() is not None, f"the end of {command}", timeout_s)
        finally:
            process.kill()
        texts = (os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).decode() for file in (out, errors))
        return subprocess.CompletedProcess(command, process.poll() or 0, *texts)


@contextmanager
def own_node(name: str, *arguments: str) -> Iterator[Node]:
    """A node of this process, with the arguments of a command line."""
    context = Context()
    rclpy.init(args=list(arguments), context=context)
    node = rclpy.create_node(name, context=context, start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def wait_until(
    condition: Callable[[], Result], what: str, timeout_s: float = TIMEOUT_S, poll_s: float = _POLL_S
) -> Result:
    """Wait until ``condition()`` is true, and return what it gave; a failure names ``what``."""
    deadline = time.monotonic() + timeout_s
    while not (result := condition()):
        assert time.monotonic() < deadline, f"waited {timeout_s:g} s for {what}"
        time.sleep(poll_s)
    return result


class Probe:
    """A node in the test's own process that publishes to others and collects what they publish."""

    def __init__(self, name: str = "probe") -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self.node: Node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Client] = {}

    def __enter__(self) -> "Probe":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the node, which others of this process would see otherwise."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def collect(self, message_type: type, topic: str, qos: QoSProfile | int = 1000) -> list[Any]:
        """A list that grows with every message on ``topic`` while ``spin_until`` runs."""
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, qos)
        return received

    def spin_until(self, condition: Callable[[], Result], what: str, timeout_s: float = TIMEOUT_S) -> Result:
        """Take messages until ``condition()`` is true, and return what it gave."""
        deadline = time.monotonic() + timeout_s
        while not (result := condition()):
            assert time.monotonic() < deadline, f"waited {timeout_s:g} s for {what}"
            self._executor.spin_once(timeout_sec=0.02)
        return result

    def meet(self, *nodes: str) -> None:
        """Wait until running nodes know every publisher and subscription that this one has made so far.

        `get_subscription_count` and `count_publishers` say what this side knows; what a node publishes before it knows
        of a subscription never comes. Discovery tells of ends in the order in which they were made. Those of the
        service that is called here come last, so a node that answers knows all of them.
        """
        for name in nodes:
            client = self.node.create_client(GetParameters, f"{name}/get_parameters")
            self.spin_until(client.service_is_ready, f"service {name}/get_parameters")
            answers: list[Any] = []
            asked_s = 0.0

            def answered() -> bool:
                nonlocal asked_s
                if time.monotonic() - asked_s > _ASK_AGAIN_S:
                    asked_s = time.monotonic()
                    answers.append(client.call_async(GetParameters.Request()))  # noqa: B023
                return any(answer.done() for answer in answers)  # noqa: B023

            self.spin_until(answered, f"an answer of {name}")
            self.node.destroy_client(client)

    def call(self, service_type: Any, name: str, request: Any) -> Any:
        """Call a service of a node, NODE/SERVICE, and return its response."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(service_type, name)
            self.meet(name.rpartition("/")[0])  # an answer to who is not known yet is lost
        client = self._clients[name]
        self.spin_until(client.service_is_ready, f"service {name}")
        future = client.call_async(request)
        self.spin_until(future.done, f"an answer of {name}")
        return future.result()

    def set_parameter(self, node: str, name: str, value: Any) -> str:
        """Set a parameter of a running node; returns why it was refused, or nothing."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        (result,) = self.call(SetParameters, f"{node}/set_parameters", request).results
        return "" if result.successful else str(result.reason)

    @contextmanager
    def patient(self, node: str, usual_s: float) -> Iterator[None]:
        """Within it a node takes nobody for silent whom a busy machine holds up; then its timeout is the usual one."""
        assert self.set_parameter(node, "source_timeout_s", min(10 * TIMEOUT_S, 3600.0)) == ""
        try:
            yield
        finally:
            assert self.set_parameter(node, "source_timeout_s", usual_s) == ""


class Diagnostics:
    """What nodes say about themselves on /diagnostics; nodes are named in full."""

    def __init__(self, probe: Probe) -> None:
        self._probe = probe
        self._since_ns = 0
        self._arrays: list[DiagnosticArray] = []
        probe.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 1000)

    def _take(self, message: DiagnosticArray, info: dict[str, Any]) -> None:
        if info["source_timestamp"] >= self._since_ns:
            self._arrays.append(message)

    def clear(self) -> None:
        """Forget what was said up to now, also what is still on its way."""
        self._since_ns = time.time_ns()
        self._arrays.clear()

    def arrays(self, node: str) -> list[DiagnosticArray]:
        """The messages of a node since then, which hold one status each."""
        return [array for array in self._arrays if array.status[0].name == node]

    def statuses(self, node: str) -> list[DiagnosticStatus]:
        """What a node said since then."""
        return [array.status[0] for array in self.arrays(node)]

    def values(self, node: str) -> dict[str, str]:
        """The newest values that a node said; empty: it said nothing."""
        return {entry.key: entry.value for status in self.statuses(node)[-1:] for entry in status.values}

    def wait_for_problem(self, node: str, *texts: str) -> str:
        """Wait until a node has warned with these texts, and return the message."""

        def found() -> str:
            for status in self.statuses(node):
                if status.level == DiagnosticStatus.WARN and all(text in status.message for text in texts):
                    return str(status.message)
            return ""

        return self._probe.spin_until(found, f"a warning of {node} with {texts} in diagnostics")

    def wait_for_value(self, node: str, key: str, accepted: Callable[[str], Any]) -> str:
        """Wait until a node's newest value of ``key`` is accepted, and return it."""

        def found() -> str | None:
            value = self.values(node).get(key)
            return value if value is not None and accepted(value) else None

        return str(self._probe.spin_until(found, f"a fitting '{key}' of {node} in diagnostics"))
