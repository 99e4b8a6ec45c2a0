"""Starts nodes as real processes in a ROS domain of their own, and ends them: shared by the demo and by tests."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from ament_index_python.packages import PackageNotFoundError, get_package_prefix

FIRST_FREE_DOMAIN = 51
"""The ROS domains from here on are for `free_domain_id`; those below are for test runs, which claim theirs first."""

_LOG_TAIL_LINES = 15
_POLL_S = 0.05
_END_S = 20.0  # a loaded machine; a second Ctrl-C kills at once
_ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class GraphError(RuntimeError):
    """A node could not start, died, or did not do in time what was waited for; the text holds what it wrote last."""


@dataclass(frozen=True)
class NodeSpec:
    """One node to run: `ros2 run package executable`, with parameters and further ROS arguments (remappings)."""

    package: str
    executable: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    ros_arguments: tuple[str, ...] = ()

    def command(self) -> list[str]:
        """The command line; raises GraphError where the workspace has no such executable."""
        try:
            program = Path(get_package_prefix(self.package), "lib", self.package, self.executable)
        except PackageNotFoundError:
            raise GraphError(f"there is no package {self.package}: build the workspace and source env.sh") from None
        if not program.exists():
            raise GraphError(f"there is no executable {program}: build the workspace")
        command = [str(program), "--ros-args", *self.ros_arguments]
        for name, value in self.parameters.items():
            # JSON-like YAML on one line, without the document's end that safe_dump adds to a bare scalar.
            text = yaml.safe_dump(value, default_flow_style=True, width=1_000_000).removesuffix("...\n").strip()
            command += ["-p", f"{name}:={text}"]
        return command


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C and requests to end until the block is left. Only in the main thread, which alone gets them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    # A handler of Python's is not passed on to a process that is started in the block; a mask of signals would be.
    handlers = {number: signal.signal(number, lambda got, _: held.append(got)) for number in _ENDINGS}
    try:
        yield
    finally:
        for ending, handler in handlers.items():
            signal.signal(ending, handler)
        for number in held:
            signal.raise_signal(number)


class Graph:
    """The nodes of one run, each with a log file. Leaving the `with` block ends them all, whatever happened."""

    def __init__(self, logs: Path, domain_id: int | None = None) -> None:
        logs.mkdir(parents=True, exist_ok=True)
        self.domain_id = free_domain_id() if domain_id is None else domain_id
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Graph:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A node that is told to end takes its own children along (maze3d its engine); one that is killed cannot.
        try:
            for process in self._processes.values():
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
            deadline = time.monotonic() + _END_S
            for process in self._processes.values():
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))
        finally:
            for process in self._processes.values():
                if process.poll() is None:
                    process.kill()
                process.wait()

    def start(self, spec: NodeSpec) -> None:
        """Start a node; its executable's name is its name here."""
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(self.domain_id),
            "PYTHONUNBUFFERED": "1",
            "RCUTILS_LOGGING_USE_STDOUT": "0",
        }
        environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        command = spec.command()
        # A process that was started and is not yet known here would never be ended.
        with self._log_path(spec.executable).open("wb") as log, uninterrupted():
            # A session of its own: Ctrl-C in the terminal reaches this program alone, which then ends the nodes in
            # order.
            self._processes[spec.executable] = subprocess.Popen(
                command, stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True
            )

    def exit_code(self, name: str) -> int | None:
        """The exit code of a node that has ended, else None."""
        return self._processes[name].poll()

    def pid(self, name: str) -> int:
        """The process of a node."""
        return self._processes[name].pid

    def check(self) -> None:
        """Raise GraphError for a node that has ended with another exit code than 0."""
        for name, process in self._processes.items():
            if process.poll() not in (None, 0):
                raise GraphError(f"{name} ended with exit code {process.returncode}; it wrote last:\n{self.tail(name)}")

    def wait_for(
        self,
        condition: Callable[[], bool],
        what: str,
        timeout_s: float,
        step: Callable[[], None] = lambda: time.sleep(_POLL_S),
    ) -> None:
        """Call step until condition holds; raise GraphError when a node dies or after timeout_s."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self.check()
            if time.monotonic() > deadline:
                tails = "\n".join(f"--- {name} wrote last:\n{self.tail(name)}" for name in self._processes)
                raise GraphError(f"waited {timeout_s:g} s for {what}\n{tails}")
            step()

    def stop(self, timeout_s: float = 20.0) -> None:
        """End every node with SIGINT; raise GraphError for one that does not end in time, or not with exit code 0."""
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for name, process in self._processes.items():
            try:
                process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                raise GraphError(
                    f"{name} did not end within {timeout_s:g} s after SIGINT; it wrote last:\n{self.tail(name)}"
                ) from None
        self.check()

    def tail(self, name: str) -> str:
        """The last lines that a node wrote."""
        lines = self._log_path(name).read_text(errors="replace").splitlines()
        return "\n".join(f"    {line}" for line in lines[-_LOG_TAIL_LINES:]) or "    (nothing)"

    def _log_path(self, name: str) -> Path:
        return self._logs / f"{name}.log"


def free_domain_id() -> int:
    """A ROS domain that no process of this machine uses now, and that no test run claims.

    The first participant of domain d takes UDP port 7410 + 250 d; above domain 101 these ports meet those that Linux
    hands out by itself.
    """
    domains = range(FIRST_FREE_DOMAIN, 102)
    for offset in range(len(domains)):
        domain_id = domains[(os.getpid() + offset) % len(domains)]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7410 + 250 * domain_id))
            except OSError:
                continue
            return domain_id
    raise GraphError(f"all ROS domains from {domains[0]} to {domains[-1]} are in use on this machine")
