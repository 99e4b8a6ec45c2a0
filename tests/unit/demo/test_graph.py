"""Nodes are ended whatever happens, also where Ctrl-C comes while one starts."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from demo.graph import Graph, GraphError, NodeSpec


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


class FailingNode(NodeSpec):
    """A process that ends as a node does which cannot start."""

    def command(self) -> list[str]:
        """The command line."""
        return [sys.executable, "-c", "import sys; print('there is no folder /nowhere'); sys.exit(2)"]


def test_it_says_which_node_failed_and_what_it_wrote(tmp_path: Path) -> None:
    said = r"node ended with exit code 2; it wrote last:\n *there is no folder /nowhere"
    with Graph(tmp_path, domain_id=1) as graph:
        graph.start(FailingNode("package", "node"))
        with pytest.raises(GraphError, match=said):
            graph.wait_for(lambda: False, "what never comes", 60.0)
