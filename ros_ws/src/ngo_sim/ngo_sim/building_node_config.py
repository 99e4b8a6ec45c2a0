"""How the node of the building publishes: pace, stamps, topics and frames."""

from __future__ import annotations

from dataclasses import dataclass

from ngo_common.settings import BadParameter, frame, setting, topic, topics
from ngo_sim.paced_config import FLOW_CONTROL, PacedConfig


@dataclass(frozen=True)
class BuildingNodeConfig(PacedConfig):
    """Settings of the node; building, scanner, wheels and driver have their own."""

    flow_control_topics: tuple[str, ...] = topics(("ngo/pose",), FLOW_CONTROL)
    draw_robot: bool = setting(
        False, "Whether scanner and wheels are drawn from the seed. Their own parameters then have no effect."
    )
    start_time_s: float = setting(1.0, "Stamp of the first scan in simulated time.", minimum=0.3, maximum=2000000000.0)
    publish_clock: bool = setting(False, "Whether /clock is published with the stamp of every scan.")
    wheel_odometry_topic: str = topic("wheel_odom", "Odometry of the wheels, with their errors.")
    publish_tf: bool = setting(False, "Whether /tf has the wheel odometry, from odom_frame to base_frame.")
    ground_truth_frame: str = frame("building", "Frame of the ground truth: origin at the corner of the floor plan.")
    odom_frame: str = frame("odom", "Frame of the wheel odometry.")
    base_frame: str = frame("base_link", "Frame of the robot: its centre.")
    laser_frame: str = frame("laser", "Frame of the scan. /tf_static has its mounting on base_frame.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.laser_frame == self.base_frame:
            raise BadParameter(
                f"parameter 'laser_frame' is {self.laser_frame!r}; allowed: another name than base_frame's"
            )

    def stamp_ns(self, seconds: float) -> int:
        """Simulated time of a moment since the start."""
        return round(self.start_time_s * 1e9) + round(seconds * 1e9)
