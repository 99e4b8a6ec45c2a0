"""The launch file of this name in ngo_bringup, with the same arguments."""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    # ngo_bringup depends on this package, so package.xml cannot name it in turn.
    path = [FindPackageShare("ngo_bringup"), "/launch/graph.launch.py"]
    return LaunchDescription([IncludeLaunchDescription(PythonLaunchDescriptionSource(path))])
