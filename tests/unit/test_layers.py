"""The layers of the design hold: a test reads every import and fails on a crossing."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "ngo_common": ROOT / "ros_ws/src/ngo_common/ngo_common",
    "ngo_recordings": ROOT / "ros_ws/src/ngo_recordings/ngo_recordings",
    "ngo_sim": ROOT / "ros_ws/src/ngo_sim/ngo_sim",
    "ngo_estimator": ROOT / "ros_ws/src/ngo_estimator/ngo_estimator",
    "ngo_explorer": ROOT / "ros_ws/src/ngo_explorer/ngo_explorer",
}
OUTSIDE = {name: ROOT / name for name in ("training", "benchmarks", "demo", "tests")}
# These serve both packages and know of neither; they do not know each other.
SHARED = ("ngo_common", "ngo_recordings")
# What nodes are built from without being nodes: benchmarks send the same messages, and time the same writer.
PARTS_OF_NODES = ("ngo_estimator.nodes.messages", "ngo_estimator.nodes.path_message")
ROS = ("rclpy", "builtin_interfaces", "ament_index_python", "rosidl_runtime_py", "launch", "launch_ros")

# In the package of this name, a module beside the folders is a command.
COMMANDS = "training"

# A module may import, directly or through others, none of a later layer. A name is a folder or a module of the package.
LAYERS = {
    "ngo_recordings": [
        {"errors"},
        {
            "bounds",
            "calibration",
            "carmen_lines",
            "carmen_poses",
            "carmen_stamps",
            "definition_cost",
            "definitions",
            "images",
            "poses",
            "stamps",
        },
        {"recording", "writer"},
        {"topics", "laser_scan"},
        {"space_scan"},
        {"frames", "mounting", "scan_stream"},
        {"lidar_description"},
    ],
    "ngo_sim": [
        {"mazes", "convex_shapes"},
        {"drivers", "maze2d", "maze3d", "corridors", "furniture", "lidar", "wheels"},
        {"driver_choice", "floor_plans"},
        {"episodes", "routes"},
        {"building_drivers", "people"},
        {"building2d"},
    ],
    "ngo_estimator": [
        {"geometry", "data"},
        {"networks"},
        {"graph"},
        {"loops"},
        {"ngo"},
        {"checkpoint"},
        {"frontend", "slam", "trajectory", "mapping"},
        {"offline", "view"},
        {"nodes"},
    ],
    "ngo_explorer": [
        {"settings", "known_map"},
        {"frontiers", "planner", "boundary"},
        {"put_aside", "rules", "path_follower"},
        {"exploration"},
        {"pilot"},
        {"warm_up"},
        {"nodes"},
    ],
    "training": [{"common"}, {"data"}, {"recordings", "driver", "baselines"}, {"scoring"}, {"report"}],
}
# Of one layer, these do not know each other: the back end takes relative poses, whoever makes them.
APART = {("ngo_estimator.slam", "ngo_estimator.frontend"), ("ngo_estimator.frontend", "ngo_estimator.slam")}


def imported_names(source: str, module: str, is_package: bool = False) -> set[str]:
    """Absolute dotted names that a module's source imports, anywhere in it.

    `from a import b` gives both `a` and `a.b`, for `b` may be a module.
    """
    names: set[str] = set()
    package = module if is_package else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - (node.level - 1)]
                base = ".".join([*above, *([base] if base else [])])
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            function = node.func
            called = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
            if called in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                names.add(node.args[0].value)
    return names


def read_imports() -> dict[str, set[str]]:
    """What every module of the project imports, by the module's dotted name."""
    imports: dict[str, set[str]] = {}
    for name, folder in {**PACKAGES, **OUTSIDE}.items():
        for path in sorted(folder.rglob("*.py")):
            is_package = path.stem == "__init__"
            parts = path.relative_to(folder).with_suffix("").parts
            module = ".".join([name, *(parts[:-1] if is_package else parts)])
            imports[module] = imported_names(path.read_text(encoding="utf-8"), module, is_package)
    return imports


def is_below(name: str, folder: str) -> bool:
    return name == folder or name.startswith(folder + ".")


def crossings(imports: Mapping[str, set[str]]) -> Iterator[str]:
    """One line for each import that crosses a layer."""
    for module, names in imports.items():
        top = module.partition(".")[0]
        in_node = is_below(module, f"{top}.nodes")
        for name in sorted(names):
            target = name.partition(".")[0]
            if top in PACKAGES:
                if not in_node and (target in ROS or target.endswith("_msgs")):
                    yield f"{module} imports {name}: only nodes know of ROS"
                if target in PACKAGES and target not in ((top,) if top in SHARED else (top, *SHARED)):
                    yield f"{module} imports {name}: the packages meet in training, in tests, or through messages"
                if target in OUTSIDE:
                    yield f"{module} imports {name}: a package imports nothing that is not installed with it"
            if target == "vizdoom" and module != "ngo_sim.doom_engine" and top != "tests":
                yield f"{module} imports {name}: only ngo_sim.doom_engine does"
            if target == "rerun" and module != "ngo_estimator.view.rerun_view":
                yield f"{module} imports {name}: only ngo_estimator.view.rerun_view does"
            for package in PACKAGES:
                own = is_below(module, f"{package}.nodes") or (package in SHARED and in_node)
                own |= top == "benchmarks" and any(is_below(name, part) for part in PARTS_OF_NODES)
                if is_below(name, f"{package}.nodes") and not own and top != "tests":
                    yield f"{module} imports {name}: nothing imports a node"
    yield from upward_imports(imports)


def layer_of(module: str) -> int | None:
    """The layer that a module stands in by its folder or its name, or None where it has none."""
    package, _, inside = module.partition(".")
    part = inside.partition(".")[0]
    layers = LAYERS.get(package, [])
    last = len(layers) if package == COMMANDS and part else None
    return next((index for index, names in enumerate(layers) if part in names), last)


def reached_from(module: str, imports: Mapping[str, set[str]]) -> set[str]:
    """The modules of the project that a module imports, directly or through others."""
    reached: set[str] = set()
    todo = [module]
    while todo:
        for name in imports.get(todo.pop(), set()) & imports.keys() - reached:
            reached.add(name)
            todo.append(name)
    return reached


def upward_imports(imports: Mapping[str, set[str]]) -> Iterator[str]:
    """One line for each module that reaches, over whatever path, one of a later layer of its package."""
    for module in sorted(imports):
        level = layer_of(module)
        if level is None:
            continue
        package = module.partition(".")[0]
        for name in sorted(reached_from(module, imports)):
            other = layer_of(name) if is_below(name, package) else None
            if other is not None and other > level:
                command = package == COMMANDS and other == len(LAYERS[package])
                yield f"{module} reaches {name}: it is {'a command' if command else 'of a later layer'}"
            elif name == module:
                yield f"{module} imports itself in a circle"
            elif any(is_below(module, a) and is_below(name, b) for a, b in APART):
                yield f"{module} reaches {name}: the two stand side by side"


def test_no_import_crosses_a_layer() -> None:
    imports = read_imports()
    assert {"ngo_sim.mazes", "ngo_estimator.geometry.se2"} <= imports.keys(), "the packages were not found"
    assert list(crossings(imports)) == []


# Modules that planted imports reach.
KNOWN = ("ngo_sim.episodes", "ngo_sim.routes", "training.train_local", "training.data.worlds", "training.report.tables")


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("ngo_sim.mazes", "import rclpy", "only nodes know of ROS"),
        ("ngo_sim.mazes", "def late():\n    from nav_msgs.msg import Path", "only nodes know of ROS"),
        ("training.data", "import vizdoom", "only ngo_sim.doom_engine does"),
        ("ngo_estimator.view.live_view", "import rerun as rr", "only ngo_estimator.view.rerun_view does"),
        ("ngo_sim.nodes.maze2d_node", "from ngo_estimator.geometry import se2", "the packages meet"),
        ("ngo_estimator.data.a", "import importlib\nimportlib.import_module('ngo_sim.mazes')", "the packages meet"),
        ("ngo_common.settings", "from ngo_recordings import errors", "the packages meet"),
        ("ngo_estimator.geometry.se2", "from training import losses", "not installed with it"),
        ("training.evaluate", "from ngo_estimator.nodes import ngo_node", "nothing imports a node"),
        ("ngo_estimator.frontend.camera", "from ..nodes.local_node import LocalNode", "nothing imports a node"),
        ("ngo_sim.mazes", "from .episodes import Episode", "later layer"),
        ("ngo_sim.lidar", "from ngo_sim.routes import RouteMap", "later layer"),
        ("training.data.feature_store", "from training import train_local", "a command"),
        ("training.common.runs", "from training.data import worlds", "later layer"),
        ("training.scoring.metrics", "from training.report.tables import Table", "later layer"),
        ("ngo_sim.doom_engine", "import vizdoom", None),
        ("ngo_sim.nodes.maze2d_node", "import rclpy\nfrom ngo_sim.maze2d import Maze2D\nfrom . import a", None),
        ("training.data", "from ngo_sim import episodes\nfrom ngo_estimator.geometry import se2", None),
        ("benchmarks.online", "from ngo_estimator.nodes.path_message import PathWriter", None),
        ("training.results", "from training import train_local", None),
    ],
)
def test_a_planted_crossing_is_caught_and_an_allowed_import_is_not(
    module: str, source: str, complaint: str | None
) -> None:
    imports = {**{name: set[str]() for name in KNOWN}, module: imported_names(source, module)}
    found = list(crossings(imports))
    assert bool(found) == (complaint is not None)
    assert all(str(complaint) in line for line in found)


def test_a_crossing_through_other_modules_is_caught() -> None:
    imports = {
        "ngo_estimator.geometry.se2": {"ngo_estimator.helpers"},
        "ngo_estimator.helpers": {"ngo_estimator.slam.online_trajectory"},
        "ngo_estimator.slam.online_trajectory": set[str](),
    }
    assert list(crossings(imports)) == [
        "ngo_estimator.geometry.se2 reaches ngo_estimator.slam.online_trajectory: it is of a later layer"
    ]


def test_every_folder_of_the_training_has_a_layer() -> None:
    folders = {path.parent.name for path in OUTSIDE["training"].glob("*/__init__.py")}
    assert folders == set().union(*LAYERS["training"])


def test_demo_benchmarks_and_evaluation_start_without_the_framework_of_trainings() -> None:
    """Its import takes longer than all else that they begin with."""
    imports = read_imports()
    starts = ["demo.run", "training.evaluate", *(module for module in imports if is_below(module, "benchmarks"))]
    reached = set(starts).union(*(reached_from(start, imports) for start in starts))
    assert "training.common.records" in reached and len(starts) > 5
    assert [name for name in sorted(reached) if any(is_below(one, "lightning") for one in imports[name])] == []
