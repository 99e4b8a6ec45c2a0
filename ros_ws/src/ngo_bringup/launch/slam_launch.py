"""SLAM with a 2D lidar on a robot that publishes odom -> base_link: in the place of nav2_bringup's file of this name.

    ros2 launch ngo_bringup slam_launch.py use_sim_time:=true
    ros2 launch nav2_bringup navigation_launch.py use_sim_time:=true

The arguments are those that Nav2 gives to its own slam_launch.py, and rviz and view. The parameters of config/slam.yaml
hold where params_file does not say otherwise, so that it may be Nav2's file.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from ngo_bringup import parts


def make_nodes(context: LaunchContext) -> list[Node]:
    files = [[FindPackageShare("ngo_bringup"), "/config/slam.yaml"]]
    files += [LaunchConfiguration("params_file")] if parts.text(context, "params_file") else []
    own = {"use_sim_time": True} if parts.is_on(context, "use_sim_time") else {}
    lifecycle = {"autostart": parts.is_on(context, "autostart")}
    options = {
        "arguments": ["--ros-args", "--log-level", LaunchConfiguration("log_level")],
        "respawn": parts.is_on(context, "use_respawn"),
    }
    return [
        parts.node("ngo_estimator", "local_node", files, own, **options),
        parts.node("ngo_estimator", "ngo_node", files, own | lifecycle, **options),
        parts.node("ngo_estimator", "ngo_map", files, own, **options),
        *parts.viewers(context),
    ]


def generate_launch_description() -> LaunchDescription:
    arguments = [
        parts.argument("namespace", ""),
        parts.argument("params_file", ""),
        parts.switch("use_sim_time"),
        parts.switch("autostart", "true"),
        parts.switch("use_respawn"),
        parts.argument("log_level", "info"),
        parts.switch("rviz"),
        parts.switch("view"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_nodes)])
