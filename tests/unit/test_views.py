"""The configurations of RViz and Foxglove show what the nodes publish."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.ros.readme_tables import TOPICS_AND_SERVICES, table_rows

VIEWS = Path(__file__).parents[2] / "ros_ws/src/ngo_bringup"
# What a display of RViz shows. Of the classes without a topic, TF alone.
TYPES = {
    "Map": "nav_msgs/OccupancyGrid",
    "Path": "nav_msgs/Path",
    "MarkerArray": "visualization_msgs/MarkerArray",
    "PoseWithCovariance": "geometry_msgs/PoseWithCovarianceStamped",
    "Odometry": "nav_msgs/Odometry",
    "LaserScan": "sensor_msgs/LaserScan",
    "Image": "sensor_msgs/Image",
}


@pytest.fixture
def types() -> dict[str, str]:
    """Types of messages by topic."""
    rows = table_rows(TOPICS_AND_SERVICES.read_text(), "## Topics")
    return {row[0].strip("`"): row[1].strip("`") for row in rows}


@pytest.fixture
def rviz() -> dict[str, Any]:
    return dict(yaml.safe_load((VIEWS / "rviz/ngo.rviz").read_text()))


@pytest.fixture
def foxglove() -> dict[str, Any]:
    return dict(json.loads((VIEWS / "foxglove/ngo.json").read_text()))


def test_rviz_shows_topics_that_exist_with_displays_of_their_type(rviz: dict[str, Any], types: dict[str, str]) -> None:
    manager = rviz["Visualization Manager"]
    shown = {}
    for display in manager["Displays"]:
        package, kind = display["Class"].split("/")
        assert package == "rviz_default_plugins" and display["Enabled"] == display["Value"]
        if kind in TYPES:
            topic = display["Topic"]["Value"]
            shown[topic] = kind
            assert types[topic] == TYPES[kind], topic
            assert set(display["Topic"]) >= {"Depth", "Durability Policy", "History Policy", "Reliability Policy"}
    assert set(shown) == {"map", "ngo/path", "ngo/loops", "ngo/pose", "odom", "scan", "image"}
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert "rviz_default_plugins/TF" in [display["Class"] for display in manager["Displays"]]
    (tool,) = (tool for tool in manager["Tools"] if tool["Class"].endswith("SetInitialPose"))
    assert types[tool["Topic"]["Value"]] == "geometry_msgs/PoseWithCovarianceStamped"


def test_rviz_asks_for_no_more_than_the_nodes_offer(rviz: dict[str, Any]) -> None:
    """A reliable subscriber hears no best effort publisher, and a latched map comes only to those that ask for it."""
    by_topic = {
        display["Topic"]["Value"]: display["Topic"]
        for display in rviz["Visualization Manager"]["Displays"]
        if "Topic" in display
    }
    assert by_topic["map"]["Durability Policy"] == "Transient Local"
    assert {name for name, topic in by_topic.items() if topic["Reliability Policy"] == "Best Effort"} == {
        "scan",
        "image",
    }, "robots publish sensors best effort"


def leaves(layout: Any) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
        return
    assert layout["direction"] in ("row", "column") and 0 < layout["splitPercentage"] < 100
    yield from leaves(layout["first"])
    yield from leaves(layout["second"])


def test_foxglove_places_every_panel_once(foxglove: dict[str, Any]) -> None:
    assert sorted(leaves(foxglove["layout"])) == sorted(foxglove["configById"])
    assert {name.split("!")[0] for name in foxglove["configById"]} == {"3D", "Image", "Plot", "DiagnosticSummary"}


def test_foxglove_shows_topics_that_exist(foxglove: dict[str, Any], types: dict[str, str]) -> None:
    panels = {name.split("!")[0]: panel for name, panel in foxglove["configById"].items()}
    known = {name if name.startswith("/") else f"/{name}" for name in types}
    scene = panels["3D"]
    assert set(scene["topics"]) <= known and scene["followTf"] == "map"
    assert set(scene["topics"]) >= {"/map", "/ngo/path", "/ngo/loops", "/ngo/pose", "/odom", "/scan"}
    assert scene["topics"]["/ngo/pose"]["showCovariance"] and scene["publish"]["poseEstimateTopic"] in known
    plotted = {path["value"].split(".")[0] for path in panels["Plot"]["paths"]}
    assert plotted | {panels["Image"]["imageMode"]["imageTopic"], panels["DiagnosticSummary"]["topicToRender"]} <= known
