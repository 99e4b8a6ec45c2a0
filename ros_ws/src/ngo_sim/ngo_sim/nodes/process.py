"""From a simulator node's class to a process."""

from __future__ import annotations

import inspect
from typing import Any

from ngo_common.nodes.process import run_node
from ngo_common.settings import Settings, usage


def run_simulator(
    node_type: Any,
    name: str,
    settings_types: tuple[type[Settings], ...],
    args: list[str] | None = None,
    **defaults: Any,
) -> int:
    """Run a simulator until it has published its frames or gets a signal; returns the process's exit code.

    node_type: a node class with ``run(ended)``; its docstring's first paragraph is the summary of ``--help``.
    settings_types, defaults: its parameters, and values that replace the defaults of their fields.
    """
    summary = (inspect.getdoc(node_type) or "").partition("\n\n")[0]
    text = usage("ngo_sim", name, summary, *settings_types, **defaults)
    return run_node(name, lambda: node_type(name), text, lambda node, ended: node.run(ended), args)
