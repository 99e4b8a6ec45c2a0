"""The whole graph: simulator, local_node and ngo_node.

    ros2 launch ngo_estimator graph.launch.py world:=maze3d parameters:=/path/to/own.yaml

The simulator begins when local_node listens to its images and ngo_node is up. When it ends, everything ends.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    world, parameters = LaunchConfiguration("world"), LaunchConfiguration("parameters")
    shipped = PathJoinSubstitution([FindPackageShare("ngo_estimator"), "config", ["graph_", world, ".yaml"]])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "world", default_value="maze3d", choices=["maze2d", "maze3d"], description="which world"
            ),
            DeclareLaunchArgument(
                "parameters", default_value=shipped, description="YAML with the parameters of all nodes"
            ),
            Node(
                package="ngo_estimator",
                executable="local_node",
                name="local_node",
                output="screen",
                parameters=[parameters],
            ),
            Node(
                package="ngo_estimator",
                executable="ngo_node",
                name="ngo_node",
                output="screen",
                parameters=[parameters],
            ),
            Node(
                package="ngo_sim",
                executable=world,
                name=world,
                output="screen",
                parameters=[parameters],
                on_exit=[Shutdown()],
            ),
        ]
    )
