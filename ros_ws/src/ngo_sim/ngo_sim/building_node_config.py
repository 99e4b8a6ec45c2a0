"""How the node of the building publishes: pace, stamps, topics and frames."""

from __future__ import annotations

from dataclasses import dataclass

from ngo_common.settings import BadParameter, FramedSettings, frame, setting, topic, topics


@dataclass(frozen=True)
class BuildingNodeConfig(FramedSettings):
    """Settings of the node; building, scanner, wheels and driver have their own."""

    seed: int = setting(
        0, "Seed of everything random: building, people, doors, drive, noise.", minimum=0, maximum=2147483647
    )
    draw_robot: bool = setting(
        False, "Whether scanner and wheels are drawn from the seed. Their own parameters then have no effect."
    )
    rate: float = setting(
        10.0,
        "Scans a second of wall time; 0: as fast as the subscribers take them, none lost.",
        minimum=0.0,
        maximum=10000.0,
    )
    frames: int = setting(
        0, "Number of scans after which the node ends with exit code 0; 0: endless.", minimum=0, maximum=2147483647
    )
    wait_for_subscribers: int = setting(
        0, "Number of subscribers of the scan that the first scan waits for.", minimum=0, maximum=100
    )
    wait_for_flow_control: bool = setting(
        False, "Whether the first scan waits until each of flow_control_topics has a publisher."
    )
    flow_control_topics: tuple[str, ...] = topics(
        ("ngo/pose",),
        "Stamped topics of the nodes that process the scans. At rate 0 the simulator stays at most max_in_flight scans "
        "ahead of the slowest one that has a publisher.",
    )
    max_in_flight: int = setting(
        4, "Number of scans that the slowest flow control topic may be behind at rate 0.", minimum=1, maximum=1000
    )
    stall_timeout_s: float = setting(
        10.0,
        "Wall time without a message on the flow control topics after which the simulator takes its scans for lost "
        "and goes on, at rate 0; 0: never.",
        minimum=0.0,
        maximum=3600.0,
    )
    start_time_s: float = setting(1.0, "Stamp of the first scan in simulated time.", minimum=0.3, maximum=2000000000.0)
    publish_clock: bool = setting(False, "Whether /clock is published with the stamp of every scan.")
    wheel_odometry_topic: str = topic("wheel_odom", "Odometry of the wheels, with their errors.")
    publish_tf: bool = setting(False, "Whether /tf has the wheel odometry, from odom_frame to base_frame.")
    record: str = setting(
        "",
        "File for a recording of everything that is published: a new .mcap file, or a new folder for the layout of "
        "rosbag2; empty: no recording.",
    )
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
