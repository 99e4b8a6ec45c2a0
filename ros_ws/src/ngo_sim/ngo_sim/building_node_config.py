"""How the node of the building publishes: pace, stamps, topics and frames."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BuildingNodeConfig:
    """Settings of the node; building, scanner, wheels and driver have their own."""

    seed: int = 0  # building, people, doors, drive and noise are functions of this number [0 to 2147483647]
    draw_robot: bool = False  # whether scanner and wheels are drawn from the seed; their parameters then do not count
    rate: float = 10.0  # scans a second of wall time; 0: as fast as the subscribers take them, none lost [0 to 10000]
    frames: int = 0  # scans to publish before the node ends with exit code 0; 0: endless [0 to 2147483647]
    wait_for_subscribers: int = 0  # subscribers that the scan must have before the first is published [0 to 100]
    flow_control_topics: tuple[str, ...] = ("ngo/pose",)  # stamped answers; at rate 0 the node waits for the slowest
    max_in_flight: int = 4  # scans at rate 0 that the slowest flow control topic may be behind [1 to 1000]
    stall_timeout_s: float = 10.0  # wall time at rate 0 without an answer until it goes on; 0: for ever [0 to 3600]
    start_time_s: float = 1.0  # stamp of the first scan in simulated time [0.3 to 2000000000]
    publish_clock: bool = False  # whether /clock is published with the stamp of every scan
    wheel_odometry_topic: str = "odom"  # topic of the wheel odometry [a name that is not empty]
    publish_tf: bool = False  # whether the wheel odometry goes on TF, too, from odom_frame to base_frame
    record: str = ""  # recording of all topics: a new .mcap file, or a new folder for rosbag2's layout; empty: none
    ground_truth_frame: str = "building"  # frame of the ground truth, which is not on TF [a name that is not empty]
    odom_frame: str = "odom"  # frame of the wheel odometry [a name that is not empty]
    base_frame: str = "base_link"  # frame of the robot's middle [a name that is not empty]
    laser_frame: str = "laser"  # frame of the scan; /tf_static has its mounting [a name that is not empty]

    def __post_init__(self) -> None:
        for name, low, high in (
            ("seed", 0, 2**31 - 1),
            ("rate", 0.0, 10_000.0),
            ("frames", 0, 2**31 - 1),
            ("wait_for_subscribers", 0, 100),
            ("max_in_flight", 1, 1000),
            ("stall_timeout_s", 0.0, 3600.0),
            ("start_time_s", 0.3, 2e9),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} is {value!r}; it must be a number from {low:g} to {high:g}")
        for name in ("wheel_odometry_topic", "ground_truth_frame", "odom_frame", "base_frame", "laser_frame"):
            if not getattr(self, name):
                raise ValueError(f"{name} is ''; it must be a name that is not empty")
        if self.laser_frame == self.base_frame:
            raise ValueError(f"laser_frame is {self.laser_frame!r}; it must differ from base_frame")

    def stamp_ns(self, seconds: float) -> int:
        """Simulated time of a moment since the start."""
        return round(self.start_time_s * 1e9) + round(seconds * 1e9)
