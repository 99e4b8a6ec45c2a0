"""A few seconds of the fuzzer: whatever comes is taken or refused with one clear line. `make fuzz` runs for minutes."""

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fuzz import files, nodes
from tests.fuzz.outcomes import Outcomes
from tests.ros.processes import own_node, wait_until

pytestmark = pytest.mark.processes

FILES, MESSAGES, SERVICES = 80, 150, 150
TAKES_LONG = {"recordings": 60}


def assert_clean(outcomes: Outcomes, count: int) -> None:
    assert not outcomes.faults, "\n".join(outcomes.faults.values())
    assert outcomes.counts["taken"] + outcomes.counts["clean line"] == count


@pytest.mark.parametrize("name", files.TARGETS)
def test_mutants_of_files(name: str, tmp_path: Path) -> None:
    count = TAKES_LONG.get(name, FILES)
    outcomes = files.run(name, count, random.Random(name), tmp_path)
    assert_clean(outcomes, count)
    assert outcomes.counts["clean line"] > 0


@pytest.mark.parametrize("name", nodes.NODES)
def test_messages(name: str) -> None:
    outcomes = nodes.run_messages(name, MESSAGES, random.Random(name))
    assert_clean(outcomes, MESSAGES)
    assert outcomes.counts["clean line"] > 0 and outcomes.counts["taken"] > 0


def test_services_in_every_state() -> None:
    assert_clean(nodes.run_services(SERVICES, random.Random(0)), SERVICES)


def test_a_destroyed_node_leaves_the_graph(tmp_path: Path) -> None:
    """Its state machine holds it otherwise until Python collects what refers to itself."""
    with own_node("watcher") as watcher:
        with nodes.NODES["ngo_node"](tmp_path) as (node, _):
            wait_until(lambda: set(watcher.get_node_names()) == {"watcher", "ngo_node"}, "ngo_node")
        wait_until(lambda: watcher.get_node_names() == ["watcher"], "the end of ngo_node")
    del node  # which lived until here


@pytest.mark.parametrize(
    ("work", "kind"),
    [
        (lambda: None, "taken"),
        (lambda: "a line", "clean line"),
        (lambda: "two\nlines", "traceback"),
        (lambda: int("x"), "clean line"),
        (lambda: {}[1], "traceback"),
    ],
)
def test_outcomes_are_told_apart(work: Callable[[], str | None], kind: str) -> None:
    outcomes = Outcomes()
    outcomes.add("an input", work, (ValueError,))
    assert outcomes.counts == {kind: 1} and len(outcomes.faults) == (kind == "traceback")
