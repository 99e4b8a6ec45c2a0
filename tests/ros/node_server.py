"""Starts nodes as forks of one process that has imported and compiled what all of them need.

A node spends seconds of processor time on imports and on compiled code before it is ready; a fork has both already.
What it runs is the installed executable, with the command line, environment and folder that it is given.
``tests/ros/test_readme_tables.py`` starts each node as a user does.
"""

import gc
import json
import os
import random
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
MODULES = (
    "ngo_estimator.nodes.image_input",
    "ngo_estimator.nodes.lidar_input",
    "ngo_estimator.nodes.local_node",
    "ngo_estimator.nodes.ngo_map",
    "ngo_estimator.nodes.ngo_node",
    "ngo_estimator.nodes.recorded_output",
    "ngo_estimator.nodes.run_recording",
    "ngo_explorer.nodes.explore_node",
    "ngo_sim.nodes.building2d_node",
    "ngo_sim.nodes.maze2d_node",
    "ngo_sim.nodes.maze3d_node",
)
_MOST_BYTES = 1 << 20


class NodeServer:
    """The process that is forked, and the way to ask it; nodes become children of the one that asks."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-u", "-m", "tests.ros.node_server", str(theirs.fileno())]
        self._process = subprocess.Popen(command, cwd=ROOT, pass_fds=[theirs.fileno()])
        theirs.close()

    def start(self, command: list[str], environment: dict[str, str], out: int, errors: int) -> "Forked":
        """Start a Python program by its command line; it writes to these file descriptors."""
        request = json.dumps([command, environment, os.getcwd()]).encode()
        socket.send_fds(self._socket, [request], [out, errors])
        answer = self._socket.recv(_MOST_BYTES)
        if not answer:
            raise RuntimeError(f"the server of nodes has ended with exit code {self._process.wait()}")
        return Forked(int(answer))


class Forked:
    """A node that was forked, as a ``subprocess.Popen``."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Its exit code once it has ended, negative for a signal."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal where it has not ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


def serve(requests: socket.socket) -> list[str]:
    """Answer each request with the process id of a new node, which returns its command line; ends without a client."""
    while True:
        request, written, *_ = socket.recv_fds(requests, _MOST_BYTES, 2)
        if not request:
            sys.exit(0)
        reader, writer = os.pipe()
        between = os.fork()
        if between == 0:
            # The node's parent ends at once: it becomes a child of the nearest process that adopts orphans, the tests'.
            node = os.fork()
            if node == 0:
                return _become(json.loads(request), *written, (reader, writer, requests.detach()))
            os.write(writer, str(node).encode())
            os._exit(0)
        os.waitpid(between, 0)
        requests.send(os.read(reader, 20))
        for descriptor in (reader, writer, *written):
            os.close(descriptor)


def _become(request: list[Any], out: int, errors: int, inherited: tuple[int, ...]) -> list[str]:
    """Take over what a process of its own would have been started with."""
    command, environment, folder = request
    os.dup2(out, 1)
    os.dup2(errors, 2)
    for descriptor in (out, errors, *inherited):
        os.close(descriptor)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    tempfile.tempdir = None
    random.seed()
    return command


def _prepare() -> None:
    """Import and compile what nodes need."""
    import torch

    from ngo_estimator.mapping import scan_map
    from ngo_estimator.offline import warm_up_scans, warm_up_trajectory
    from ngo_estimator.slam.online_trajectory import OnlineTrajectory
    from ngo_explorer.warm_up import warm_up
    from ngo_sim.building2d import Building2d

    from .relative_poses import WORLD, write_weights

    for module in MODULES:
        import_module(module)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # threads do not survive a fork
    warm_up_scans.warm_up_scans()
    scan_map.warm_up()
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        write_weights(Path(folder))
        warm_up_trajectory.warm_up_networks(OnlineTrajectory.load(Path(folder), 32, WORLD))
    building = Building2d()
    building.reset(0)
    building.step()
    torch.set_num_threads(threads)
    gc.freeze()  # what a collection does not touch stays shared


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # nodes are ended by the tests
    _prepare()
    sys.argv = serve(socket.socket(fileno=int(sys.argv[1])))
    runpy.run_path(sys.argv[0], run_name="__main__")
