"""The whole graph with exploration: simulator, local_node, ngo_node, ngo_map and explore.

    ros2 launch ngo_bringup explore.launch.py world:=building2d seed:=7
    ros2 launch ngo_bringup explore.launch.py world:=building2d plan:=my_floor.yaml
    ros2 launch ngo_bringup explore.launch.py world:=none drive:=nav2      # a robot of yours, beside Nav2

The robot begins to explore at once; with autostart:=false it waits for the action `explore`. With world:=none there is
no simulator, and odometry comes from /tf.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction, Shutdown
from launch_ros.actions import Node

from ngo_bringup import parts


def make_nodes(context: LaunchContext) -> list[Node]:
    plan, simulated = parts.text(context, "plan"), parts.text(context, "world") != "none"
    own = {"use_sim_time": True} if parts.is_on(context, "use_sim_time") else {}
    file = parts.parameters()
    explorer = own | {"drive": parts.text(context, "drive"), "autostart": parts.is_on(context, "autostart")}
    ends = {"plan": plan} if plan else {}
    return [
        *(parts.node("ngo_estimator", name, [file], own) for name in ("local_node", "ngo_node", "ngo_map")),
        parts.node("ngo_explorer", "explore", [file], explorer),
        *([parts.simulator(context, ends, on_exit=[Shutdown()])] if simulated else []),
        *parts.viewers(context),
    ]


def generate_launch_description() -> LaunchDescription:
    arguments = [
        *parts.simulator_arguments("ngo_bringup/config/explore_", parts.EXPLORED),
        parts.argument("plan", ""),
        parts.argument("drive", "own", parts.DRIVES),
        parts.switch("autostart", "true"),
        parts.switch("rviz"),
        parts.switch("view"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_nodes)])
