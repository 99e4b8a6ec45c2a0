"""Nodes bring settings for Fast DDS, which must be able to read them, and keep those that a user names."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from ngo_common.nodes import process

pytestmark = pytest.mark.processes
FILES = {
    "jazzy": ("FASTRTPS_DEFAULT_PROFILES_FILE", "fast_dds.xml"),
    "kilted": ("FASTDDS_DEFAULT_PROFILES_FILE", "fast_dds_3.xml"),
}


NODE_THAT_REFUSES = """
import os, sys
from ngo_common.nodes import process
def refuse():
    raise process.StartError("this node does not start")
assert process.run_node("node", refuse, "", args=["node"]) == 2
print(os.environ[sys.argv[1]])
"""


@pytest.mark.parametrize("distro", FILES)
@pytest.mark.parametrize("named", [None, "/of/the/user.xml"])
def test_a_user_names_other_settings(named: str | None, distro: str) -> None:
    variable, ours = FILES[distro]
    names = {variable for variable, _ in FILES.values()}
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment |= {"ROS_DISTRO": distro} | ({variable: named} if named else {})
    # A process of its own: one that runs a node keeps the node's handlers of signals.
    run = subprocess.run(
        [sys.executable, "-c", NODE_THAT_REFUSES, variable], env=environment, capture_output=True, text=True, check=True
    )
    used = Path(run.stdout.strip())
    assert used == Path(named) if named else (used.is_file() and used.name == ours)


@pytest.mark.parametrize(
    ("name", "element"), [("fast_dds.xml", "heartbeatPeriod"), ("fast_dds_3.xml", "heartbeat_period")]
)
def test_the_heartbeat_of_fast_dds_is_short(name: str, element: str) -> None:
    """That it can read the file, a start of a simulator in test_sim_nodes.py shows."""
    used = Path(process.__file__).with_name(name)
    space = {"": ElementTree.parse(used).getroot().tag.partition("}")[0].strip("{")}
    period = ElementTree.parse(used).find(f".//publisher[@is_default_profile='true']/times/{element}", space)
    assert period is not None
    seconds, nanoseconds = (int(period.findtext(name, "", space)) for name in ("sec", "nanosec"))
    assert 0.01 <= seconds + 1e-9 * nanoseconds <= 0.1
