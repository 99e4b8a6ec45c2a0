"""One simulator.

ros2 launch ngo_sim maze.launch.py world:=maze3d parameters:=/path/to/own.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    world = LaunchConfiguration("world")
    shipped = PathJoinSubstitution([FindPackageShare("ngo_sim"), "config", [world, ".yaml"]])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "world",
                default_value="maze3d",
                choices=["maze2d", "maze3d", "building2d"],
                description="which simulator",
            ),
            DeclareLaunchArgument(
                "parameters", default_value=shipped, description="YAML with the simulator's parameters"
            ),
            Node(
                package="ngo_sim",
                executable=world,
                name=world,
                output="screen",
                parameters=[LaunchConfiguration("parameters")],
            ),
        ]
    )
