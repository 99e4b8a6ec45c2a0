"""The live view of a run: a node of its own, which stays when the others have ended."""

from __future__ import annotations

import contextlib
import re
import sys
import time
from pathlib import Path
from types import TracebackType

from demo.graph import Graph, NodeSpec

_START_TIMEOUT_S = 60.0
_NODE = "view_node"


class DemoView:
    """Starts ``view_node`` in a ROS domain of its own; the graph to be shown runs in the same ``domain_id``."""

    def __init__(self, logs: Path) -> None:
        self._graph = Graph(logs)
        self.domain_id = self._graph.domain_id
        self.url = ""

    def __enter__(self) -> DemoView:
        self._graph.__enter__()
        self._graph.start(NodeSpec("ngo_estimator", _NODE))
        try:
            self._graph.wait_for(lambda: bool(self._found_url()), "the live view", _START_TIMEOUT_S)
        except BaseException:
            self._graph.__exit__(None, None, None)
            raise
        self.url = self._found_url()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._graph.__exit__(kind, error, trace)

    def stay(self) -> None:
        """Go on until Ctrl-C where a person sits at the terminal; elsewhere return at once."""
        if not sys.stdin.isatty():
            return
        print(f"the live view stays at {self.url}; Ctrl-C ends it", file=sys.stderr)
        with contextlib.suppress(KeyboardInterrupt):
            while self._graph.exit_code(_NODE) is None:
                time.sleep(0.2)

    def _found_url(self) -> str:
        found = re.search(r"open (http\S+)", self._graph.tail(_NODE))
        return found[1] if found else ""
