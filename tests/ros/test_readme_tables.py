"""The tables of parameters, topics and services in docs/reference match the nodes."""

import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from .readme_tables import (
    PARAMETERS,
    TOPICS_AND_SERVICES,
    NodeFacts,
    documented_endpoints,
    generated_part,
    parameter_section,
    running_nodes,
    table_rows,
)

pytestmark = pytest.mark.processes

DISCOVERY_S = 30.0


@pytest.fixture(scope="module")
def nodes() -> Iterator[dict[str, NodeFacts]]:
    with running_nodes() as facts:
        yield facts


def once_equal(look: Callable[[], set[Any]], expected: set[Any]) -> set[Any]:
    """What is seen once it is what is expected, or at last: discovery tells of a node's ends one after another."""
    deadline_s = time.monotonic() + DISCOVERY_S
    while (seen := look()) != expected and time.monotonic() < deadline_s:
        time.sleep(0.1)
    return seen


def test_parameters(nodes: dict[str, NodeFacts]) -> None:
    """Names, defaults, meanings and limits are those of the nodes' descriptors."""
    text = PARAMETERS.read_text()
    begin, end = generated_part(text)
    documented, declared = text[begin:end].splitlines(), parameter_section(nodes).splitlines()
    missing = [line for line in declared if line not in documented]
    wrong = [line for line in documented if line not in declared]
    assert (missing, wrong) == ([], []), "run: python -m tests.ros.readme_tables"


def test_topics(nodes: dict[str, NodeFacts]) -> None:
    documented = documented_endpoints(TOPICS_AND_SERVICES.read_text())
    declared = once_equal(lambda: set().union(*(node.endpoints() for node in nodes.values())), documented)
    assert sorted(documented) == sorted(declared)


def test_services(nodes: dict[str, NodeFacts]) -> None:
    documented = set()
    for service, kind, node, _ in table_rows(TOPICS_AND_SERVICES.read_text(), "## Services"):
        name = re.sub("^~", "/" + node.strip("`"), service.strip("`"))
        package, short = kind.strip("`").split("/")
        documented.add((name, f"{package}/srv/{short}"))
    assert documented == once_equal(lambda: set().union(*(node.services() for node in nodes.values())), documented)
