"""The arguments and the nodes that launch files put together."""

from launch import LaunchContext
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

WORLDS = ["maze2d", "maze3d", "building2d"]
EXPLORED = ["building2d", "maze2d", "none"]
DRIVES = ["own", "nav2", "none"]
TRUTH_VALUES = {"true": True, "false": False, "True": True, "False": False}  # Nav2 writes them with a capital letter
_DESCRIPTIONS = {
    "world": "simulator",
    "parameters": "YAML with parameters of all nodes",
    "params_file": "YAML whose parameters replace those of config/slam.yaml; empty: none",
    "namespace": "namespace of all nodes; empty: none",
    "seed": "seed of the simulator; empty: of parameters",
    "record": "new .mcap file or folder for what the simulator publishes",
    "use_sim_time": "follow /clock, which a simulator started here then publishes",
    "autostart": "whether it begins by itself; else ngo_node waits for lifecycle transitions, explore for its action",
    "plan": "YAML file of a map server's map, as the building of building2d; empty: a drawn one",
    "drive": "who drives: explore itself, Nav2, or nobody here",
    "use_respawn": "whether a node that ends is started again, with an empty map",
    "log_level": "lowest severity that nodes print",
    "rviz": "show the graph in RViz",
    "view": "show the graph in the browser; needs requirements/view.txt",
}


def argument(name: str, default: object, choices: list[str] | None = None) -> DeclareLaunchArgument:
    """One of the arguments that the launch files share."""
    return DeclareLaunchArgument(name, default_value=default, description=_DESCRIPTIONS[name], choices=choices)


def switch(name: str, default: str = "false") -> DeclareLaunchArgument:
    """An argument that is true or false."""
    return argument(name, default, list(TRUTH_VALUES))


def simulator_arguments(shipped: str, worlds: list[str] | None = None) -> list[DeclareLaunchArgument]:
    """The arguments of ``simulator``; the file of parameters is one of ``shipped``, a package and a prefix.

    worlds: the choices, the first of which is the default.
    """
    package, prefix = shipped.split("/", 1)
    # PathJoinSubstitution takes no nested lists before launch 3.4.5: texts side by side are concatenated instead.
    file = [FindPackageShare(package), f"/{prefix}", LaunchConfiguration("world"), ".yaml"]
    return [
        argument("world", worlds[0] if worlds else "maze3d", worlds or WORLDS),
        argument("parameters", file),
        argument("namespace", ""),
        argument("seed", ""),
        argument("record", ""),
        switch("use_sim_time"),
    ]


def text(context: LaunchContext, name: str) -> str:
    """The value of an argument."""
    return str(LaunchConfiguration(name).perform(context))


def is_on(context: LaunchContext, name: str) -> bool:
    """The value of a ``switch``."""
    return TRUTH_VALUES[text(context, name)]


def node(package: str, executable: str, files: list[object], own: dict, **options: object) -> Node:
    """A node in the launch file's namespace, with all its topics; ``own`` parameters replace those of ``files``."""
    return Node(
        package=package,
        executable=executable,
        name=executable,
        namespace=LaunchConfiguration("namespace"),
        remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
        parameters=[*files, *([own] if own else [])],
        output="screen",
        **options,
    )


def parameters() -> LaunchConfiguration:
    """The file with the parameters of all nodes."""
    return LaunchConfiguration("parameters")


def simulator(context: LaunchContext, more: dict | None = None, **options: object) -> Node:
    """The simulator; arguments that are empty leave the file of parameters as it is. more: other parameters."""
    seed, record = text(context, "seed"), text(context, "record")
    own = {"seed": int(seed)} if seed else {}
    own |= more or {}
    own |= {"record": record} if record else {}
    own |= {"publish_clock": True} if is_on(context, "use_sim_time") else {}
    return node("ngo_sim", text(context, "world"), [parameters()], own, **options)


def viewers(context: LaunchContext) -> list[Node]:
    """What the arguments rviz and view ask for."""
    own = {"use_sim_time": True} if is_on(context, "use_sim_time") else {}
    wanted = []
    if is_on(context, "rviz"):
        shown = [FindPackageShare("ngo_bringup"), "/rviz/ngo.rviz"]
        wanted.append(node("rviz2", "rviz2", [], own, arguments=["-d", shown]))
    if is_on(context, "view"):
        wanted.append(node("ngo_estimator", "view_node", [], own))
    return wanted
