"""How the node of the building publishes: pace, stamps, topics and frames."""

from __future__ import annotations

from dataclasses import dataclass

from ngo_common.settings import BadParameter, FramedSettings, frame, setting, topic, topics


@dataclass(frozen=True)
class BuildingNodeConfig(FramedSettings):
    """Settings of the node; building, scanner, wheels and driver have their own."""

    seed: int = setting(
        0, "Building, people, doors, drive and noise are functions of this number.", minimum=0, maximum=2147483647
    )
    draw_robot: bool = setting(
        False, "Whether scanner and wheels are drawn from the seed; their parameters then do not count."
    )
    rate: float = setting(
        10.0,
        "Scans a second of wall time; 0: as fast as the subscribers take them, none lost.",
        minimum=0.0,
        maximum=10000.0,
    )
    frames: int = setting(
        0, "Scans to publish before the node ends with exit code 0; 0: endless.", minimum=0, maximum=2147483647
    )
    wait_for_subscribers: int = setting(
        0, "Subscribers that the scan must have before the first is published.", minimum=0, maximum=100
    )
    flow_control_topics: tuple[str, ...] = topics(
        ("ngo/pose",), "Stamped answers; at rate 0 the node waits for the slowest."
    )
    max_in_flight: int = setting(
        4, "Scans at rate 0 that the slowest flow control topic may be behind.", minimum=1, maximum=1000
    )
    stall_timeout_s: float = setting(
        10.0, "Wall time at rate 0 without an answer until it goes on; 0: for ever.", minimum=0.0, maximum=3600.0
    )
    start_time_s: float = setting(1.0, "Stamp of the first scan in simulated time.", minimum=0.3, maximum=2000000000.0)
    publish_clock: bool = setting(False, "Whether /clock is published with the stamp of every scan.")
    wheel_odometry_topic: str = topic("wheel_odom", "Topic of the wheel odometry.")
    publish_tf: bool = setting(False, "Whether the wheel odometry goes on TF, too, from odom_frame to base_frame.")
    record: str = setting(
        "", "Recording of all topics: a new .mcap file, or a new folder for rosbag2's layout; empty: none."
    )
    ground_truth_frame: str = frame("building", "Frame of the ground truth, which is not on TF.")
    odom_frame: str = frame("odom", "Frame of the wheel odometry.")
    base_frame: str = frame("base_link", "Frame of the robot's middle.")
    laser_frame: str = frame("laser", "Frame of the scan; /tf_static has its mounting.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.laser_frame == self.base_frame:
            raise BadParameter(
                f"parameter 'laser_frame' is {self.laser_frame!r}; allowed: another name than base_frame's"
            )

    def stamp_ns(self, seconds: float) -> int:
        """Simulated time of a moment since the start."""
        return round(self.start_time_s * 1e9) + round(seconds * 1e9)
