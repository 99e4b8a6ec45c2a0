"""Parameters of the node."""

from dataclasses import dataclass

from ngo_common.settings import FramedSettings, frame, setting, topic

DRIVES = ("nav2", "own", "none")


@dataclass(frozen=True)
class ExploreNodeSettings(FramedSettings):
    """How the node gets the map and the pose, and who drives."""

    drive: str = setting(
        "nav2",
        "Who drives. nav2: its action navigate_to_pose; own: this node, by cmd_vel; none: somebody else, who takes "
        "explore/goal.",
        choices=DRIVES,
    )
    autostart: bool = setting(
        False, "Whether to explore at once, everywhere and without a limit, as with an empty goal."
    )
    map_topic: str = topic("map", "The occupancy grid. Its changes are taken from the topic with _updates behind.")
    scan_topic: str = topic("scan", "Laser scan that drive own stops by, where the map lacks what it shows.")
    cmd_vel_topic: str = topic("cmd_vel", "Velocities, with drive own.")
    pose_topic: str = topic("ngo/pose", "Pose with covariance, of which the deviation is taken. The pose comes by TF.")
    diagnostics_topic: str = topic("/diagnostics", "Where localisation_node says whether the robot is lost.")
    localisation_node: str = setting("ngo_node", "Name, or its end, of the status that says whether the robot is lost.")
    navigate_action: str = topic("navigate_to_pose", "Nav2's action, with drive nav2.")
    map_frame: str = frame("map", "Frame of the map.")
    base_frame: str = frame("base_link", "Frame of the robot: its centre.")
    control_rate: float = setting(20.0, "Velocities a second, with drive own.", minimum=1.0, maximum=200.0)
    settle_s: float = setting(
        2.5, "Longest time until the map holds what the robot sees, s.", minimum=0.1, maximum=60.0
    )
    pose_timeout_s: float = setting(
        1.0,
        "Age of the pose, and of the scan with drive own, from which on the robot waits, s.",
        minimum=0.05,
        maximum=60.0,
    )
    lost_timeout_s: float = setting(
        60.0, "Time without a pose, a map or certainty after which an exploration ends, s.", minimum=1.0, maximum=3600.0
    )
    deviation_m: float = setting(
        0.5, "Standard deviation of the position above which the robot counts as lost, m.", minimum=0.01, maximum=100.0
    )
    nav2_timeout_s: float = setting(
        10.0, "Time within which Nav2 must answer a goal, s. Then it counts as failed.", minimum=0.5, maximum=600.0
    )
