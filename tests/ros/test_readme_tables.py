"""README.md's tables of parameters, topics and services are what the nodes have."""

import re
from collections.abc import Iterator

import pytest

from .readme_tables import (
    README,
    NodeFacts,
    documented_endpoints,
    parameter_section,
    readme_part,
    readme_rows,
    running_nodes,
)

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def nodes() -> Iterator[dict[str, NodeFacts]]:
    with running_nodes() as facts:
        yield facts


def test_parameters(nodes: dict[str, NodeFacts]) -> None:
    """Names, defaults, meanings and what is allowed: the text is that which the nodes' descriptors give."""
    text = README.read_text()
    begin, end = readme_part(text)
    documented, declared = text[begin:end].splitlines(), parameter_section(nodes).splitlines()
    missing = [line for line in declared if line not in documented]
    wrong = [line for line in documented if line not in declared]
    assert (missing, wrong) == ([], []), "run: python -m tests.ros.readme_tables"


def test_topics(nodes: dict[str, NodeFacts]) -> None:
    declared = set().union(*(node.endpoints() for node in nodes.values()))
    assert sorted(documented_endpoints(README.read_text())) == sorted(declared)


def test_services(nodes: dict[str, NodeFacts]) -> None:
    documented = set()
    for service, kind, node, _ in readme_rows(README.read_text(), "Services:"):
        name = re.sub("^~", "/" + node.strip("`"), service.strip("`"))
        package, short = kind.strip("`").split("/")
        documented.add((name, f"{package}/srv/{short}"))
    assert documented == set().union(*(node.services() for node in nodes.values()))
