"""The whole graph: simulator, local_node and ngo_node.

    ros2 launch ngo_bringup graph.launch.py world:=maze3d seed:=7 record:=drive.mcap

The simulator begins when local_node listens to its images or scans and ngo_node is up. When it ends, everything ends.
In a namespace all topics, TF among them, are the robot's own: start it again with another one for a second robot.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TRUTH_VALUES = {"true": True, "false": False}


def make_nodes(context: LaunchContext) -> list[Node]:
    """The three nodes; arguments that are empty leave the file of parameters as it is."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ("world", "seed", "record", "use_sim_time")}
    world, simulated = given["world"], TRUTH_VALUES[given["use_sim_time"]]
    simulator = {"seed": int(given["seed"])} if given["seed"] else {}
    simulator |= {"record": given["record"]} if given["record"] else {}
    simulator |= {"publish_clock": True} if simulated else {}
    estimator = {"use_sim_time": True} if simulated else {}

    def node(package: str, executable: str, own: dict, **options: object) -> Node:
        return Node(
            package=package,
            executable=executable,
            name=executable,
            namespace=LaunchConfiguration("namespace"),
            remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
            parameters=[LaunchConfiguration("parameters"), *([own] if own else [])],
            output="screen",
            **options,
        )

    return [
        node("ngo_estimator", "local_node", estimator),
        node("ngo_estimator", "ngo_node", estimator),
        node("ngo_sim", world, simulator, on_exit=[Shutdown()]),
    ]


def generate_launch_description() -> LaunchDescription:
    # PathJoinSubstitution takes no nested lists before launch 3.4.5: texts side by side are concatenated instead.
    shipped = [FindPackageShare("ngo_bringup"), "/config/graph_", LaunchConfiguration("world"), ".yaml"]
    arguments = [
        DeclareLaunchArgument(
            "world", default_value="maze3d", choices=["maze2d", "maze3d", "building2d"], description="simulator"
        ),
        DeclareLaunchArgument("parameters", default_value=shipped, description="YAML with parameters of all nodes"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes; empty: none"),
        DeclareLaunchArgument("seed", default_value="", description="seed of the simulator; empty: of parameters"),
        DeclareLaunchArgument(
            "record", default_value="", description="new .mcap file or folder for what the simulator publishes"
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=list(TRUTH_VALUES),
            description="the simulator publishes /clock, and the estimators follow it",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_nodes)])
