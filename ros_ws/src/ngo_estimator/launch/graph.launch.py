"""The whole graph: simulator, local_node and ngo_node.

    ros2 launch ngo_estimator graph.launch.py world:=maze3d parameters:=/path/to/own.yaml namespace:=red

The simulator begins when local_node listens to its images and ngo_node is up. When it ends, everything ends. In a
namespace all topics, TF among them, are the robot's own: start it again with another one for a second robot.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    world, parameters = LaunchConfiguration("world"), LaunchConfiguration("parameters")
    robot = {
        "namespace": LaunchConfiguration("namespace"),
        "remappings": [("/tf", "tf"), ("/tf_static", "tf_static")],
        "parameters": [parameters],
        "output": "screen",
    }
    shipped = PathJoinSubstitution([FindPackageShare("ngo_estimator"), "config", ["graph_", world, ".yaml"]])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "world", default_value="maze3d", choices=["maze2d", "maze3d"], description="which world"
            ),
            DeclareLaunchArgument(
                "parameters", default_value=shipped, description="YAML with the parameters of all nodes"
            ),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes; empty: none"),
            Node(package="ngo_estimator", executable="local_node", name="local_node", **robot),
            Node(package="ngo_estimator", executable="ngo_node", name="ngo_node", **robot),
            Node(package="ngo_sim", executable=world, name=world, on_exit=[Shutdown()], **robot),
        ]
    )
