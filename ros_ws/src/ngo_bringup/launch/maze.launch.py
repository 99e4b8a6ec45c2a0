"""One simulator.

ros2 launch ngo_bringup maze.launch.py world:=maze3d seed:=7 record:=drive.mcap
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction
from launch_ros.actions import Node

from ngo_bringup import parts


def make_nodes(context: LaunchContext) -> list[Node]:
    return [parts.simulator(context)]


def generate_launch_description() -> LaunchDescription:
    arguments = parts.simulator_arguments("ngo_sim/config/")
    return LaunchDescription([*arguments, OpaqueFunction(function=make_nodes)])
