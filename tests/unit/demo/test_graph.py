"""Nodes are ended whatever happens, also where Ctrl-C comes while one starts."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from demo.graph import Graph, NodeSpec


class LongNode(NodeSpec):
    """A process that runs for an hour in place of a node."""

    def command(self) -> list[str]:
        """The command line."""
        return [sys.executable, "-c", "import time; time.sleep(3600)"]


def test_ctrl_c_while_a_node_starts_leaves_no_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def interrupted(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(start(*arguments, **options))
        signal.raise_signal(signal.SIGINT)
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", interrupted)
    with pytest.raises(KeyboardInterrupt), Graph(tmp_path, domain_id=1) as graph:
        graph.start(LongNode("package", "node"))
    assert started[0].wait(60) != 0
