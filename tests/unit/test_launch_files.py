"""The real launch has no wheels: the launch files are run against stand-ins of what they import."""

import importlib.util
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import yaml

from ngo_sim.maze2d import Maze2DConfig
from ngo_sim.maze3d import Maze3DConfig
from ngo_sim.simulator_config import SimulatorConfig

SRC = Path(__file__).parents[2] / "ros_ws" / "src"
LAUNCH_FILES = sorted(SRC.glob("*/launch/*.launch.py"))
NAMES = {
    "launch": ["LaunchDescription"],
    "launch.actions": ["DeclareLaunchArgument", "Shutdown"],
    "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
    "launch_ros": [],
    "launch_ros.actions": ["Node"],
    "launch_ros.substitutions": ["FindPackageShare"],
}


class Entity:
    """Whatever a launch file makes, with what it was made of."""

    def __init__(self, *values: Any, **named: Any) -> None:
        self.values, self.named = values, named


@pytest.fixture
def launch_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    for module_name, names in NAMES.items():
        module = types.ModuleType(module_name)
        for name in names:
            setattr(module, name, type(name, (Entity,), {}))
        monkeypatch.setitem(sys.modules, module_name, module)


def entities(path: Path) -> list[Any]:
    spec = importlib.util.spec_from_file_location(path.stem.replace(".", "_"), path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return list(module.generate_launch_description().values[0])


@pytest.mark.usefixtures("launch_stand_in")
@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_file_starts_nodes_with_parameters_from_yaml(path: Path) -> None:
    found = entities(path)
    arguments = [entity.values[0] for entity in found if type(entity).__name__ == "DeclareLaunchArgument"]
    nodes = [entity.named for entity in found if type(entity).__name__ == "Node"]
    only_graph = path.name == "graph.launch.py"
    assert arguments == ["world", "parameters", *(["namespace"] if only_graph else [])]
    if only_graph:
        assert {node["namespace"].values for node in nodes} == {("namespace",)}
        assert all(("/tf", "tf") in node["remappings"] for node in nodes)
    executables = [node["executable"] for node in nodes]
    fixed = [name for name in executables if isinstance(name, str)]
    assert fixed == ([] if path.name == "maze.launch.py" else ["local_node", "ngo_node"])
    world = executables[-1]
    assert type(world).__name__ == "LaunchConfiguration" and world.values == ("world",)
    assert all(node["parameters"] for node in nodes)


def test_there_are_launch_files_for_one_simulator_and_for_the_graph() -> None:
    assert [path.name for path in LAUNCH_FILES] == ["graph.launch.py", "maze.launch.py"]


@pytest.mark.parametrize("world", ["maze2d", "maze3d"])
@pytest.mark.parametrize("name", ["ngo_sim/config/{}.yaml", "ngo_estimator/config/graph_{}.yaml"])
def test_shipped_parameters_are_those_of_the_simulator(world: str, name: str) -> None:
    nodes = yaml.safe_load((SRC / name.format(world)).read_text())
    values = {key.removeprefix("/**/"): value for key, value in nodes.items()}[world]["ros__parameters"]
    world_type = {"maze2d": Maze2DConfig, "maze3d": Maze3DConfig}[world]
    split: tuple[dict[str, Any], dict[str, Any]] = ({}, {})
    for key, value in values.items():
        split[key in world_type.__dataclass_fields__][key] = value
    SimulatorConfig(**split[0])
    world_type(**split[1])
