"""Stand-ins for the parts of `launch` and `launch_ros` that the launch files import: no wheel has the real ones.

They refuse what `launch` 3.4.0 refuses: unknown arguments, and lists within lists of texts and substitutions.
"""

import importlib.util
import sys
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

SRC = Path(__file__).parents[2] / "ros_ws" / "src"


class Substitution:
    """A text that is known when the launch file runs."""

    def perform(self, context: "LaunchContext") -> str:
        raise NotImplementedError


class LaunchContext:
    """The arguments of one run."""

    def __init__(self) -> None:
        self.launch_configurations: dict[str, str] = {}

    def text(self, parts: list[str | Substitution]) -> str:
        return "".join(part if isinstance(part, str) else part.perform(self) for part in parts)


def texts(value: Any) -> list[str | Substitution]:
    """A text, a substitution, or several of them side by side; TypeError for anything else."""
    if isinstance(value, (str, Substitution)):
        return [value]
    if not isinstance(value, Iterable):
        raise TypeError(f"{value!r} is no text, no substitution and no list of them")
    items = list(value)
    if bad := [item for item in items if not isinstance(item, (str, Substitution))]:
        raise TypeError(f"{bad[0]!r} within a list is no text and no substitution")
    return items


class LaunchConfiguration(Substitution):
    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: LaunchContext) -> str:
        return context.launch_configurations[self.name]


class FindPackageShare(Substitution):
    def __init__(self, package: str) -> None:
        self.package = package

    def perform(self, context: LaunchContext) -> str:
        assert (SRC / self.package).is_dir()
        return str(SRC / self.package)


class PathJoinSubstitution(Substitution):
    def __init__(self, parts: Iterable[str | Substitution]) -> None:
        self.parts = texts(parts)

    def perform(self, context: LaunchContext) -> str:
        return str(Path(*(context.text([part]) for part in self.parts)))


class Entity:
    """Something that a launch description consists of."""


class DeclareLaunchArgument(Entity):
    def __init__(
        self, name: str, *, default_value: Any = None, description: str = "", choices: list[str] | None = None
    ) -> None:
        assert description and default_value is not None
        self.name, self.default, self.choices = name, texts(default_value), choices


class OpaqueFunction(Entity):
    def __init__(self, *, function: Callable[[LaunchContext], list[Entity]]) -> None:
        self.function = function


class Shutdown(Entity):
    pass


class PythonLaunchDescriptionSource:
    def __init__(self, location: Any) -> None:
        self.location = texts(location)


class IncludeLaunchDescription(Entity):
    def __init__(self, source: PythonLaunchDescriptionSource) -> None:
        self.source = source


class Node(Entity):
    def __init__(
        self,
        *,
        executable: Any,
        package: Any = None,
        name: Any = None,
        namespace: Any = None,
        parameters: list[Any] | None = None,
        remappings: list[tuple[Any, Any]] | None = None,
        output: str = "log",
        on_exit: list[Entity] | None = None,
        arguments: list[Any] | None = None,
        respawn: bool = False,
    ) -> None:
        self.executable, self.package, self.name = texts(executable), texts(package), texts(name)
        self.namespace, self.output, self.on_exit = texts(namespace or ""), output, on_exit or []
        self.remappings = [(texts(old), texts(new)) for old, new in remappings or []]
        self.arguments, self.respawn = [texts(item) for item in arguments or []], respawn
        self.files = [texts(item) for item in parameters or [] if not isinstance(item, dict)]
        self.parameters: dict[str, Any] = {}
        for item in parameters or []:
            self.parameters |= item if isinstance(item, dict) else {}
        assert all(isinstance(value, (bool, int, float, str)) for value in self.parameters.values())


class LaunchDescription:
    def __init__(self, entities: list[Entity]) -> None:
        assert all(isinstance(entity, Entity) for entity in entities)
        self.entities = entities


MODULES: dict[str, list[type]] = {
    "launch": [LaunchContext, LaunchDescription],
    "launch.actions": [DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, Shutdown],
    "launch.launch_description_sources": [PythonLaunchDescriptionSource],
    "launch.substitutions": [LaunchConfiguration, PathJoinSubstitution],
    "launch_ros": [],
    "launch_ros.actions": [Node],
    "launch_ros.substitutions": [FindPackageShare],
}


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let launch files import the stand-ins."""
    for module_name, members in MODULES.items():
        module = types.ModuleType(module_name)
        for member in members:
            setattr(module, member.__name__, member)
        monkeypatch.setitem(sys.modules, module_name, module)


class Launched:
    """What `ros2 launch PATH NAME:=VALUE ...` would start."""

    def __init__(self, path: Path, **given: str) -> None:
        self.context = LaunchContext()
        self.context.launch_configurations.update(given)
        self.arguments: list[str] = []
        self.nodes: list[Node] = []
        self._visit(path)
        assert given.keys() <= set(self.arguments)

    def _visit(self, path: Path) -> None:
        spec = importlib.util.spec_from_file_location(path.stem.replace(".", "_"), path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        for entity in module.generate_launch_description().entities:
            if isinstance(entity, IncludeLaunchDescription):
                self._visit(Path(self.context.text(entity.source.location)))
            elif isinstance(entity, DeclareLaunchArgument):
                self.arguments.append(entity.name)
                value = self.context.launch_configurations.setdefault(entity.name, self.context.text(entity.default))
                if entity.choices is not None and value not in entity.choices:
                    raise ValueError(f"{entity.name} is {value!r}; allowed: {entity.choices}")
            elif isinstance(entity, OpaqueFunction):
                found = entity.function(self.context)
                assert all(isinstance(node, Node) for node in found)
                self.nodes += [node for node in found if isinstance(node, Node)]
