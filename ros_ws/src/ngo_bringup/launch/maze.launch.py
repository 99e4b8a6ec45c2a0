"""One simulator.

ros2 launch ngo_bringup maze.launch.py world:=maze3d seed:=7 record:=drive.mcap
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TRUTH_VALUES = {"true": True, "false": False}


def make_node(context: LaunchContext) -> list[Node]:
    """The simulator; arguments that are empty leave the file of parameters as it is."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ("world", "seed", "record", "use_sim_time")}
    own = {"seed": int(given["seed"])} if given["seed"] else {}
    own |= {"record": given["record"]} if given["record"] else {}
    own |= {"publish_clock": True} if TRUTH_VALUES[given["use_sim_time"]] else {}
    return [
        Node(
            package="ngo_sim",
            executable=given["world"],
            name=given["world"],
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("parameters"), *([own] if own else [])],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    # PathJoinSubstitution takes no nested lists before launch 3.4.5: texts side by side are concatenated instead.
    shipped = [FindPackageShare("ngo_sim"), "/config/", LaunchConfiguration("world"), ".yaml"]
    arguments = [
        DeclareLaunchArgument(
            "world", default_value="maze3d", choices=["maze2d", "maze3d", "building2d"], description="simulator"
        ),
        DeclareLaunchArgument("parameters", default_value=shipped, description="YAML with the simulator's parameters"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the node; empty: none"),
        DeclareLaunchArgument("seed", default_value="", description="seed of the simulator; empty: of parameters"),
        DeclareLaunchArgument(
            "record", default_value="", description="new .mcap file or folder for what the simulator publishes"
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=list(TRUTH_VALUES),
            description="the simulator publishes /clock, for nodes with use_sim_time",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_node)])
