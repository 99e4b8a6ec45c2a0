"""The whole graph: simulator, local_node, ngo_node and ngo_map.

    ros2 launch ngo_bringup graph.launch.py world:=maze3d seed:=7 record:=drive.mcap rviz:=true

The simulator begins when local_node listens to its images or scans and ngo_node is up. When it ends, everything ends.
In a namespace all topics, TF among them, are the robot's own: start it again with another one for a second robot.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from ngo_bringup import parts


def make_nodes(context: LaunchContext) -> list[Node]:
    file = LaunchConfiguration("parameters")
    own = {"use_sim_time": True} if parts.is_on(context, "use_sim_time") else {}
    return [
        *(parts.node("ngo_estimator", name, [file], own) for name in ("local_node", "ngo_node", "ngo_map")),
        parts.simulator(context, on_exit=[Shutdown()]),
        *parts.viewers(context),
    ]


def generate_launch_description() -> LaunchDescription:
    arguments = [
        *parts.simulator_arguments("ngo_bringup/config/graph_"),
        parts.switch("rviz"),
        parts.switch("view"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_nodes)])
