"""The launch files and the parameters that they load; the real launch has no wheels."""

from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from ngo_common.settings import Settings
from ngo_estimator.nodes.settings import LocalNodeSettings, NgoNodeSettings
from ngo_explorer.nodes.settings import ExploreNodeSettings
from ngo_explorer.settings import DriveConfig, ExplorerConfig
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.building_node_config import BuildingNodeConfig
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.maze2d import Maze2DConfig
from ngo_sim.maze3d import Maze3DConfig
from ngo_sim.simulator_config import SimulatorConfig
from ngo_sim.wheels import WheelsConfig
from tests.unit.launch_stand_in import SRC, FindPackageShare, Launched, PathJoinSubstitution, Shutdown, install

LAUNCH = SRC / "ngo_bringup/launch"
GRAPH, MAZE, SLAM = LAUNCH / "graph.launch.py", LAUNCH / "maze.launch.py", LAUNCH / "slam_launch.py"
EXPLORE = LAUNCH / "explore.launch.py"
# The names by which the files were documented first.
FORWARDED = {GRAPH: SRC / "ngo_estimator/launch/graph.launch.py", MAZE: SRC / "ngo_sim/launch/maze.launch.py"}
ARGUMENTS = ["world", "parameters", "namespace", "seed", "record", "use_sim_time"]
VIEWS = ["rviz", "view"]
# What Nav2's bringup_launch.py gives to its slam_launch.py, and what that takes besides.
OF_NAV2 = ["namespace", "params_file", "use_sim_time", "autostart", "use_respawn", "log_level"]
ESTIMATORS = ["local_node", "ngo_node", "ngo_map"]
SETTINGS: dict[str, tuple[type[Settings], ...]] = {
    "maze2d": (SimulatorConfig, Maze2DConfig),
    "maze3d": (SimulatorConfig, Maze3DConfig),
    "building2d": (BuildingNodeConfig, FloorPlanConfig, BuildingDriverConfig, ScannerConfig, WheelsConfig),
}


@pytest.fixture(autouse=True)
def launch_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)


def test_every_launch_file_is_tested() -> None:
    assert sorted(SRC.glob("*/launch/*.py")) == sorted([*FORWARDED, *FORWARDED.values(), EXPLORE, SLAM])


@pytest.mark.parametrize("path", [*FORWARDED, *FORWARDED.values()], ids=lambda path: f"{path.parts[-3]}-{path.stem}")
@pytest.mark.parametrize("world", SETTINGS)
def test_nodes_start_with_the_shipped_parameters(path: Path, world: str) -> None:
    launched = Launched(path, world=world, namespace="red")
    graph = path.name == GRAPH.name
    assert launched.arguments == ARGUMENTS + (VIEWS if graph else [])
    text = launched.context.text
    executables = [text(node.executable) for node in launched.nodes]
    assert executables == [*ESTIMATORS, world] if graph else [world]
    for node in launched.nodes:
        assert text(node.namespace) == "red" and text(node.name) == text(node.executable)
        assert node.output == "screen" and node.parameters == {}
        (file,) = (Path(text(parts)) for parts in node.files)
        assert any(f"/**/{text(node.name)}" in name for name in yaml.safe_load(file.read_text()))
        remapped = {text(old): text(new) for old, new in node.remappings}
        assert remapped == {"/tf": "tf", "/tf_static": "tf_static"}
    if graph:
        assert isinstance(launched.nodes[-1].on_exit[0], Shutdown), "when the simulator ends, everything ends"


@pytest.mark.parametrize("world", SETTINGS)
@pytest.mark.parametrize("path", FORWARDED, ids=lambda path: path.stem)
def test_arguments_become_parameters_of_the_nodes_that_have_them(path: Path, world: str) -> None:
    launched = Launched(path, world=world, seed="7", record="drive.mcap", use_sim_time="true", parameters="/own.yaml")
    *estimators, simulator = launched.nodes
    assert simulator.parameters == {"seed": 7, "record": "drive.mcap", "publish_clock": True}
    SETTINGS[world][0](**simulator.parameters)
    assert all(node.parameters == {"use_sim_time": True} for node in estimators)
    assert {launched.context.text(parts) for node in launched.nodes for parts in node.files} == {"/own.yaml"}


def test_a_view_comes_on_request() -> None:
    for path in (GRAPH, SLAM):
        launched = Launched(path, rviz="true", view="True", namespace="red", use_sim_time="true")
        *_, rviz, view = launched.nodes
        text = launched.context.text
        assert [text(each.executable) for each in (rviz, view)] == ["rviz2", "view_node"]
        assert {text(each.namespace) for each in (rviz, view)} == {"red"}
        assert rviz.parameters == view.parameters == {"use_sim_time": True}
        (option, file) = (text(parts) for parts in rviz.arguments)
        assert option == "-d" and Path(file).is_file()


def test_slam_takes_the_names_of_nav2_and_needs_none() -> None:
    launched = Launched(SLAM)
    assert launched.arguments == OF_NAV2 + VIEWS
    text = launched.context.text
    assert [text(node.executable) for node in launched.nodes] == ESTIMATORS
    (shipped,) = {text(parts) for node in launched.nodes for parts in node.files}
    names = yaml.safe_load(Path(shipped).read_text())
    assert list(names) == [f"/**/{name}" for name in ESTIMATORS]
    assert [node.parameters for node in launched.nodes] == [{}, {"autostart": True}, {}]
    assert not any(node.respawn for node in launched.nodes)


def test_slam_does_what_nav2_asks_for() -> None:
    given = dict.fromkeys(("use_sim_time", "use_respawn"), "True") | {"autostart": "False", "log_level": "debug"}
    launched = Launched(SLAM, params_file="/nav2.yaml", namespace="red", **given)
    text = launched.context.text
    for node in launched.nodes:
        assert text(node.namespace) == "red" and node.respawn and node.parameters["use_sim_time"]
        assert [text(parts) for parts in node.files][1:] == ["/nav2.yaml"], "the later file wins"
        assert [text(parts) for parts in node.arguments] == ["--ros-args", "--log-level", "debug"]
    assert launched.nodes[1].parameters["autostart"] is False


def test_the_shipped_parameters_of_slam_leave_odom_to_the_robot() -> None:
    values = yaml.safe_load((SRC / "ngo_bringup/config/slam.yaml").read_text())
    local = LocalNodeSettings(**values["/**/local_node"]["ros__parameters"])
    ngo = NgoNodeSettings(**values["/**/ngo_node"]["ros__parameters"])
    assert (local.world, local.robot_odometry, ngo.world) == ("scan", "tf", "scan")
    assert local.odom_frame == ngo.odom_frame
    assert ngo.tf_ahead_s >= 0.1, "a scanner of 10 Hz"


@pytest.mark.parametrize("world", ["building2d", "maze2d", "none"])
def test_exploration_starts_the_graph_and_the_explorer(world: str) -> None:
    plan = {"plan": "/floor.yaml"} if world == "building2d" else {}
    launched = Launched(EXPLORE, world=world, use_sim_time="true", drive="nav2" if world == "none" else "own", **plan)
    text, simulator = launched.context.text, [] if world == "none" else [world]
    assert [text(node.executable) for node in launched.nodes] == [*ESTIMATORS, "explore", *simulator]
    explorer = launched.nodes[3]
    assert explorer.parameters["drive"] == ("nav2" if world == "none" else "own") and explorer.parameters["autostart"]
    (shipped,) = {text(parts) for node in launched.nodes for parts in node.files}
    values = yaml.safe_load(Path(shipped).read_text())
    own = values["/**/explore"]["ros__parameters"]
    for settings_type in (ExploreNodeSettings, ExplorerConfig, DriveConfig):
        names = {field.name for field in fields(settings_type)}
        settings_type(**{key: own.pop(key) for key in names & own.keys()})
    assert own == {}, "no part has these"
    assert LocalNodeSettings(**values["/**/local_node"]["ros__parameters"]).world == "scan"
    if simulator:
        assert launched.nodes[-1].parameters == {"publish_clock": True, **plan}
        assert values[f"/**/{world}"]["ros__parameters"]["driver"] == "cmd_vel"


def test_what_is_not_allowed_is_refused() -> None:
    for given in ({"world": "maze4d"}, {"use_sim_time": "yes"}, {"seed": "many"}):
        with pytest.raises(ValueError):
            Launched(GRAPH, **given)


def test_the_stand_in_refuses_a_list_within_a_list_as_launch_3_4_0_does() -> None:
    with pytest.raises(TypeError, match="within a list"):
        PathJoinSubstitution([FindPackageShare("ngo_sim"), "config", ["graph_", ".yaml"]])  # type: ignore[list-item]


@pytest.mark.parametrize("world", SETTINGS)
@pytest.mark.parametrize("name", ["ngo_sim/config/{}.yaml", "ngo_bringup/config/graph_{}.yaml"])
def test_shipped_parameters_are_those_of_the_simulator(world: str, name: str) -> None:
    values = yaml.safe_load((SRC / name.format(world)).read_text())[f"/**/{world}"]["ros__parameters"]
    for settings_type in SETTINGS[world]:
        own = {field.name for field in fields(settings_type)}
        settings_type(**{key: values.pop(key) for key in own & values.keys()})
    assert values == {}, "no part has these"


@pytest.mark.parametrize("world", SETTINGS)
def test_shipped_parameters_are_those_of_the_estimators(world: str) -> None:
    values = yaml.safe_load((SRC / f"ngo_bringup/config/graph_{world}.yaml").read_text())
    local, ngo = (values[f"/**/{name}"]["ros__parameters"] for name in ("local_node", "ngo_node"))
    settings = LocalNodeSettings(**local)
    assert settings.world == NgoNodeSettings(**ngo).world == ("scan" if world == "building2d" else world)
    if world == "building2d":
        assert settings.robot_odometry == "topic"
        assert settings.robot_odometry_topic == BuildingNodeConfig().wheel_odometry_topic
