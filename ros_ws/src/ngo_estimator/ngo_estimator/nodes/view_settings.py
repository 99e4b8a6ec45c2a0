"""The parameters of ``view_node``."""

from dataclasses import dataclass

from ngo_common.settings import BadParameter, FramedSettings, frame, setting, topic


@dataclass(frozen=True)
class ViewNodeSettings(FramedSettings):
    """Parameters of ``view_node``."""

    web_port: int = setting(9090, "Port of the page.", minimum=1, maximum=65535)
    data_port: int = setting(9876, "Port from which the page gets its data.", minimum=1, maximum=65535)
    open_browser: bool = setting(True, "Whether to open the page in the browser of this machine.")
    memory_mb: int = setting(
        512, "Memory for what a page that opens later still gets; the oldest goes first, MB.", minimum=16, maximum=65536
    )
    rate_hz: float = setting(4.0, "Highest rate of the view.", minimum=0.1, maximum=60.0)
    base_frame: str = frame("base_link", "Frame of the robot, on which the scanner sits.")
    image_topic: str = topic("image", "Pictures to show.")
    image_transport: str = setting(
        "raw",
        "Type of the pictures: Image, or CompressedImage on image_topic/compressed.",
        choices=("raw", "compressed"),
    )
    scan_topic: str = topic("scan", "Laser scans to show at the corrected pose.")
    tf_topic: str = topic("/tf", "Transforms; the mounting of the scanner comes from this name with _static.")
    odometry_topic: str = topic("odom", "Odometry of the robot.")
    ground_truth_topic: str = topic("ground_truth", "True poses, where something knows them.")
    trajectory_topic: str = topic("ngo/trajectory", "Corrected trajectory.")
    pose_topic: str = topic("ngo/pose", "Corrected newest pose with covariance.")
    loops_topic: str = topic("ngo/loops", "Loop closures.")
    frontiers_topic: str = topic("explore/frontiers", "What is left to explore.")
    plan_topic: str = topic("explore/path", "Path that the robot means to drive; its end is shown as the goal.")
    map_topic: str = topic("map", "Occupancy grid.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.web_port == self.data_port:
            raise BadParameter(f"parameter 'data_port' is {self.data_port}; allowed: another port than web_port")
