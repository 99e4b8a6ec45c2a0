"""Parameters, topics and services of all nodes, as they declare them and as docs/reference lists them.

python -m tests.ros.readme_tables      # writes the nodes' parameters into docs/reference/parameters.md
"""

import re
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import ReliabilityPolicy

from ngo_common.settings import Settings, described
from ngo_estimator.nodes.view_settings import ViewNodeSettings

from .processes import NodeProcess, Probe

REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference"
PARAMETERS = REFERENCE / "parameters.md"
TOPICS_AND_SERVICES = REFERENCE / "topics_and_services.md"
NODES = {
    "maze2d": "ngo_sim",
    "maze3d": "ngo_sim",
    "building2d": "ngo_sim",
    "local_node": "ngo_estimator",
    "ngo_node": "ngo_estimator",
    "ngo_map": "ngo_estimator",
    "explore": "ngo_explorer",
}
BEGIN = "<!-- Written by `python -m tests.ros.readme_tables`; a test compares it with the nodes. -->\n"
END = "<!-- End of the parameters. -->\n"
HEAD = ("| Parameter | Default | Meaning | Allowed |", "|---|---|---|---|")
_OF_AN_ACTION = "/_action/"
_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides.")


@dataclass(frozen=True, order=True)
class Endpoint:
    """A node's end of a topic."""

    node: str
    publishes: bool
    topic: str
    type: str
    reliability: str


class NodeFacts:
    """A running node, asked over ROS."""

    def __init__(self, probe: Probe, name: str) -> None:
        self._probe = probe
        self.name = name

    def parameter_rows(self) -> list[str]:
        """A row of Markdown a parameter: name, default, meaning, what is allowed."""
        names = self._ask(ListParameters, "list_parameters", ListParameters.Request()).result.names
        names = sorted(name for name in names if not name.startswith(_OF_RCLPY))
        values = self._ask(GetParameters, "get_parameters", GetParameters.Request(names=names)).values
        described = self._ask(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names))
        rows = list(HEAD)
        for name, value, descriptor in zip(names, values, described.descriptors, strict=True):
            default = default_text(parameter_value_to_python(value))
            rows.append(f"| `{name}` | {default} | {descriptor.description} | {allowed_text(descriptor)} |")
        return rows

    def endpoints(self) -> set[Endpoint]:
        """Its ends of all topics, but for those that every node has."""
        node, found = self._probe.node, set()
        for publishes in (True, False):
            by_node = (
                node.get_publisher_names_and_types_by_node if publishes else node.get_subscriber_names_and_types_by_node
            )
            by_topic = node.get_publishers_info_by_topic if publishes else node.get_subscriptions_info_by_topic
            for topic, types in by_node(self.name, "/"):
                if topic in ("/rosout", "/parameter_events") or _OF_AN_ACTION in topic:
                    continue
                (info,) = (info for info in by_topic(topic) if info.node_name == self.name)
                best_effort = info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
                reliability = "best effort" if best_effort else "reliable"
                found.add(Endpoint(self.name, publishes, topic, types[0], reliability))
        return found

    def services(self) -> set[tuple[str, str]]:
        """Names and types of its services, but for those that every node has."""
        return {
            (name, types[0])
            for name, types in self._probe.node.get_service_names_and_types_by_node(self.name, "/")
            if not types[0].startswith(("rcl_interfaces/", "type_description_interfaces/"))
            and _OF_AN_ACTION not in name
        }

    def _ask(self, service_type: Any, name: str, request: Any) -> Any:
        return self._probe.call(service_type, f"/{self.name}/{name}", request)


@contextmanager
def running_nodes() -> Iterator[dict[str, NodeFacts]]:
    """All nodes, in one graph."""
    probe = Probe()
    facts: dict[str, NodeFacts] = {}
    processes: list[NodeProcess] = []
    try:
        for name, package in NODES.items():
            processes.append(NodeProcess(package, name, fresh=True))
            facts[name] = NodeFacts(probe, name)

        def complete() -> bool:
            """The mazes listen to both estimators, the building and the explorer to ngo_node."""
            for process in processes:
                assert process.running, process.log
            ready = all("ready: " in process.log for process in processes)
            known = NODES.keys() <= set(probe.node.get_node_names())
            listeners = {"/odom": 2, "/ngo/pose": 4}
            heard = all(probe.node.count_subscribers(topic) == count for topic, count in listeners.items())
            return ready and known and heard

        probe.spin_until(complete, "all nodes")
        yield facts
    finally:
        for process in processes:
            process.__exit__(None, None, None)
        probe.close()


def default_text(value: object) -> str:
    """A parameter's value as it is written on the command line."""
    if isinstance(value, str):
        return f"`{value}`" if value else "`''`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, (list, array)):
        return f"`[{', '.join(map(str, value))}]`"
    return f"`{value}`"


def allowed_text(descriptor: ParameterDescriptor) -> str:
    """What a parameter may be."""
    if descriptor.additional_constraints:
        return descriptor.additional_constraints
    for span in (*descriptor.integer_range, *descriptor.floating_point_range):
        return f"{span.from_value:.12g} to {span.to_value:.12g}"
    return ""


def settings_rows(settings_type: type[Settings]) -> list[str]:
    """The same rows of a node that cannot run everywhere: `view_node` needs an extra."""
    rows = list(HEAD)
    for entry in sorted(fields(settings_type), key=lambda entry: entry.name):
        allowed = entry.metadata["allowed"] + ("; at any time" if entry.metadata["live"] else "")
        rows.append(f"| `{entry.name}` | {default_text(entry.default)} | {described(entry)} | {allowed} |")
    return rows


def parameter_section(facts: dict[str, NodeFacts]) -> str:
    """The generated part of the page of parameters."""
    rows = {name: node.parameter_rows() for name, node in facts.items()} | {
        "view_node": settings_rows(ViewNodeSettings)
    }
    parts = [f"## `{name}`\n\n" + "\n".join(lines) + "\n" for name, lines in rows.items()]
    return BEGIN + "\n" + "\n".join(parts) + "\n" + END


def generated_part(text: str) -> tuple[int, int]:
    """Where the generated part of the page of parameters begins and ends."""
    assert text.count(BEGIN) == text.count(END) == 1, f"{PARAMETERS} has lost the marks around the parameters"
    return text.index(BEGIN), text.index(END) + len(END)


def table_rows(text: str, heading: str) -> list[list[str]]:
    """The cells of the first table below a heading, without its head."""
    section = text.split(f"\n{heading}\n", 1)[1]
    match = re.search(r"(?:^\|.*\n)+", section, re.MULTILINE)
    assert match, f"there is no table below {heading}"
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in match.group().splitlines()]
    return rows[2:]


def documented_endpoints(text: str) -> set[Endpoint]:
    """The ends in the table of topics; only names in backticks count, so ends that exist on request are left out."""
    found = set()
    for topic, kind, publishers, subscribers, offered, asked, _ in table_rows(text, "## Topics"):
        (name,) = re.findall(r"`(.+?)`", topic)
        for publishes, nodes, qos in ((True, publishers, offered), (False, subscribers, asked)):
            for node in re.findall(r"`(.+?)`", nodes):
                resolved = name if name.startswith("/") else f"/{name}"
                package, message = kind.strip("`").split("/")
                found.add(Endpoint(node, publishes, resolved, f"{package}/msg/{message}", qos.split(",")[0]))
    return found


def main() -> None:
    """Write the nodes' parameters into their page."""
    with running_nodes() as facts:
        section = parameter_section(facts)
    text = PARAMETERS.read_text()
    begin, end = generated_part(text)
    PARAMETERS.write_text(text[:begin] + section + text[end:])


if __name__ == "__main__":
    main()
