"""The parameters of the estimator nodes: names, defaults, meanings and limits."""

import re
from dataclasses import dataclass

from ngo_common.settings import BadParameter, FramedSettings, frame, pose, setting, topic, topics

CAMERA_WORLD = "camera"  # Any calibrated camera, without weights; with weights it is a name as any other.

SHIPPED_WORLDS = ("maze2d", "maze3d", "doom", "scan", CAMERA_WORLD)
"""Worlds that need no weights but those in the package."""
_WORLD_NAMES = "maze2d, maze3d, doom, scan or camera, or the name of another one and its folder in 'weights'"


_TRANSPORTS = ("raw", "compressed")
_TWISTS = ("TwistStamped", "Twist", "Odometry")


_ROBOT_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)


def _robots(description: str) -> tuple[str, ...]:
    """A field that holds names of robots."""
    names: tuple[str, ...] = setting(
        (),
        description,
        allowed="a list of different names, each of a letter and then letters, digits and _",
        check=lambda value: (
            all(isinstance(name, str) and _ROBOT_NAME.fullmatch(name) for name in value)
            and len(set(value)) == len(value)
        ),
    )
    return names


TOPICS_OF_ROBOTS = ("relative_pose_topic", "pose_topic", "path_topic", "trajectory_topic", "loops_topic")
"""Parameters with topics that each of several robots has in its namespace."""


def _check_robots(settings: "NgoNodeSettings | MapNodeSettings") -> None:
    """Raise ``BadParameter`` about a topic that cannot be in a robot's namespace."""
    for name in TOPICS_OF_ROBOTS if settings.robots else ():
        if (value := getattr(settings, name, "")).startswith("~"):
            raise BadParameter(f"parameter '{name}' is '{value}'; allowed: a name without ~ in front, with robots")


def of_robot(robot: str, topic_name: str) -> str:
    """The name of a robot's topic: that of one robot alone, in the robot's namespace."""
    return f"{robot}/{topic_name.removeprefix('/')}"


@dataclass(frozen=True)
class StepSettings(FramedSettings):
    """Parameters of every node that publishes or takes relative poses."""

    world: str = setting(
        "maze3d",
        "World whose weights are used; doom: any map of maze3d. Without weights: scan, any 2D lidar, and camera, any "
        "calibrated camera.",
        allowed=_WORLD_NAMES,
        check=lambda value: re.fullmatch(r"[\w-]+", value) is not None,
    )
    weights: str = setting("", "Folder of weights for that world; empty: the ones that ship with the package.")
    relative_pose_topic: str = topic("relative_pose", "Steps of the odometry, from local_node to ngo_node.")
    relative_pose_depth: int = setting(
        2000, "Queue of relative_pose_topic, at least ngo_node's window_frames.", minimum=1, maximum=100_000
    )
    source_timeout_s: float = setting(
        1.0,
        "Silence of an input topic's publisher after which another publisher of the topic takes its place.",
        minimum=0.01,
        maximum=3600.0,
        live=True,
    )
    diagnostics_topic: str = topic("/diagnostics", "Rates, drops and durations of the node.")
    diagnostics_period_s: float = setting(1.0, "Time between diagnostics.", minimum=0.05, maximum=3600.0, live=True)

    @property
    def uses_camera(self) -> bool:
        """Whether pictures are tracked without weights."""
        return self.world == CAMERA_WORLD and not self.weights

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.weights and self.world not in SHIPPED_WORLDS:
            raise BadParameter(f"parameter 'world' is {self.world!r}; allowed: {_WORLD_NAMES}")


@dataclass(frozen=True)
class EstimatorSettings(StepSettings):
    """Parameters of both estimator nodes."""

    threads: int = setting(1, "Threads that the networks compute with.", minimum=1, maximum=64)
    odom_frame: str = frame("odom", "Frame in which the odometry is smooth and drifts.")
    publish_tf: bool = setting(True, "Whether to publish the transform on tf_topic.")
    tf_topic: str = topic("/tf", "Transforms.")


@dataclass(frozen=True)
class LocalNodeSettings(EstimatorSettings):
    """Parameters of ``local_node``."""

    image_topic: str = topic(
        "image", "Images to estimate motion from, with weights that take images, or with world:=camera."
    )
    image_transport: str = setting(
        "raw", "Type of the images: Image, or CompressedImage on image_topic/compressed.", choices=_TRANSPORTS
    )
    scan_topic: str = topic("scan", "Laser scans to estimate motion from, with weights that take scans.")
    scan_topics: tuple[str, ...] = topics(
        (),
        "Topics of several scanners, each with its pose on TF, whose scans are put together; in place of scan_topic.",
    )
    scan_type: str = setting(
        "LaserScan",
        "Type of the scans of a lidar: LaserScan; MultiEchoLaserScan, of which first echoes count; PointCloud2, of "
        "which the sensor's own height counts; or depth: an Image, with its CameraInfo on camera_info beside it.",
        choices=("LaserScan", "MultiEchoLaserScan", "PointCloud2", "depth"),
    )
    min_range: float = setting(
        0.0,
        "Nearer ranges of a scanner are not used, m: for a robot that its scanner sees.",
        minimum=0.0,
        maximum=100.0,
    )
    scan_yaw_deg: float = setting(
        0.0,
        "Direction of a scan's angle 0, counter-clockwise from straight ahead, degrees; other than 0 it stands for the "
        "direction on TF, which then says the scanner's place alone.",
        minimum=-360.0,
        maximum=360.0,
    )
    robot_odometry: str = setting(
        "none",
        "Odometry that the robot has of its own, with world:=scan or camera: none (a camera then takes the scale from "
        "its height over the floor), an Odometry on robot_odometry_topic, or any chain from odom_frame to base_frame "
        "on tf_topic, which then stays the robot's.",
        choices=("none", "topic", "tf"),
    )
    robot_odometry_topic: str = topic("wheel_odom", "Odometry of the robot, with robot_odometry:=topic.")
    imu_topic: str = topic(
        "imu",
        "IMU whose yaw rate stands in for the turns of the robot's odometry, with world:=scan, where it agrees better "
        "with the scans.",
    )
    points_topic: str = topic(
        "points", "Points that the newest picture's corners show, in base_frame, with world:=camera, for who listens."
    )
    image_reliability: str = setting(
        "best_effort",
        "Reliability of image_topic, scan_topic and robot_odometry_topic; reliable: lost messages are sent again.",
        choices=("best_effort", "reliable"),
    )
    image_depth: int = setting(5, "Queue of image_topic or scan_topic.", minimum=1, maximum=10_000)
    action_topic: str = topic("action", "Actions, stamped with the image at which they were taken.")
    action_timeout_s: float = setting(
        1.0,
        "Time after which an image without its action or velocity is dropped, by the stamps of newer images.",
        minimum=0.001,
        maximum=60.0,
    )
    action_capacity: int = setting(
        64,
        "Number of images that may wait for actions or velocities; then the oldest is dropped.",
        minimum=1,
        maximum=10_000,
    )
    twist_topic: str = topic("twist", "Velocities of the robot, with weights that take them.")
    twist_type: str = setting(
        "TwistStamped", "Type of twist_topic; a Twist has no stamp, so the time of its arrival counts.", choices=_TWISTS
    )
    twist_tolerance_s: float = setting(
        0.5,
        "Greatest age of a velocity at an image, where no velocity came since the previous image.",
        minimum=0.0,
        maximum=60.0,
    )
    base_frame: str = frame("base_link", "Frame of the robot.")
    odometry_topic: str = topic("odom", "Pose in odom_frame with covariance, and velocity.")
    publish_odometry: bool = setting(True, "Whether to publish odometry_topic.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.base_frame == self.odom_frame:
            raise BadParameter(
                f"parameter 'base_frame' is {self.base_frame!r}; allowed: another name than odom_frame's"
            )


@dataclass(frozen=True)
class NgoNodeSettings(EstimatorSettings):
    """Parameters of ``ngo_node``."""

    autostart: bool = setting(
        True, "Whether the node configures and activates itself; otherwise it waits for lifecycle transitions."
    )
    window_frames: int = setting(
        2000,
        "Number of newest frames that are optimised together; older frames move with them.",
        minimum=16,
        maximum=100_000,
    )
    key_frames: int = setting(
        128,
        "Number of remembered places from before the window; a return to one of them closes a loop.",
        minimum=2,
        maximum=100_000,
    )
    iterations_per_step: int = setting(
        1,
        "0: a meta-pose is optimised before its pose is published. From 1 on: behind it, from the last solution on, in "
        "one piece.",
        minimum=0,
        maximum=100,
    )
    map_frame: str = frame("map", "Frame of the corrected trajectory, which may jump.")
    robots: tuple[str, ...] = _robots(
        "Namespaces of several robots with a lidar each, which are mapped together: the topics of each are there, and "
        "its frames have the name and / in front. Empty: one robot."
    )
    initial_pose: tuple[float, float, float] = pose(
        (0.0, 0.0, 0.0),
        "Pose of a trajectory's first frame in map_frame; a change holds from the next trajectory on.",
        live=True,
    )
    initial_pose_topic: str = topic(
        "initialpose", "Current pose of the robot in map_frame; the whole trajectory moves there."
    )
    save_directory: str = setting(
        "",
        "Folder in which services may write, and ~/load_state may read; empty: the working directory of the node.",
    )
    state: str = setting("", "Folder of a saved state to go on from, relative to save_directory; empty: none.")
    state_mode: str = setting(
        "continue",
        "continue: the odometry that was saved goes on. relocalise: another one begins; the robot is looked for in the "
        "map of state, and the map grows on from where it is found; the same at each restart of local_node.",
        choices=("continue", "relocalise"),
    )
    mode: str = setting(
        "mapping",
        "mapping: the map grows with every relative pose. localization: the robot's pose is looked for in the map in "
        "state.",
        choices=("mapping", "localization"),
    )
    map_changes: str = setting(
        "ignore",
        "With mode localization. ignore: the map stays as it was saved. learn: from where the robot is found, what it "
        "sees enters the map and replaces what has changed; ~/save_state keeps it.",
        choices=("ignore", "learn"),
    )
    path_topic: str = topic("ngo/path", "Corrected trajectory.")
    pose_topic: str = topic("ngo/pose", "Corrected newest pose with covariance, after every relative pose.")
    trajectory_topic: str = topic(
        "ngo/trajectory", "Corrected trajectory in flat arrays, with the distance that each pose moved."
    )
    loops_topic: str = topic("ngo/loops", "Loop closures as lines between poses.")
    path_rate_hz: float = setting(
        10.0,
        "Highest rate of path_topic, trajectory_topic and loops_topic; 0: after every relative pose and every "
        "correction.",
        minimum=0.0,
        maximum=1000.0,
        live=True,
    )
    tf_smoothing_s: float = setting(
        0.0,
        "Time constant with which the transform on tf_topic moves toward the newest correction; 0: at once.",
        minimum=0.0,
        maximum=60.0,
        live=True,
    )
    tf_ahead_s: float = setting(
        0.0,
        "Time by which the stamp of the transform on tf_topic is ahead of its frame's. Nav2 asks for newer poses than "
        "the last frame: the time between two frames and their processing fit in here.",
        minimum=0.0,
        maximum=10.0,
        live=True,
    )
    lost_position_std_m: float = setting(
        2.0,
        "Standard deviation of the newest position above which diagnostics call the robot lost, m.",
        minimum=0.001,
        maximum=1e6,
        live=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.map_frame == self.odom_frame:
            raise BadParameter(f"parameter 'map_frame' is {self.map_frame!r}; allowed: another name than odom_frame's")
        _check_robots(self)
        if self.robots and (self.mode != "mapping" or self.state):
            raise BadParameter(
                f"parameter 'robots' is {list(self.robots)}; allowed: none with mode localization, or with a state"
            )
        for name, value in (("mode", "localization"), ("state_mode", "relocalise")):
            if getattr(self, name) == value and not self.state:
                raise BadParameter(
                    f"parameter 'state' is ''; allowed: the folder of a saved state, with {name} {value}"
                )
        if self.map_changes == "learn" and self.mode != "localization":
            raise BadParameter("parameter 'map_changes' is 'learn'; allowed: ignore, with mode mapping, which learns")
        if self.relative_pose_depth < self.window_frames:
            raise BadParameter(
                f"parameter 'relative_pose_depth' is {self.relative_pose_depth}; "
                f"allowed: at least window_frames, which is {self.window_frames}"
            )

    @property
    def keeps_map(self) -> bool:
        """Whether the map in ``state`` stays as it is."""
        return self.mode == "localization" and self.map_changes == "ignore"

    @property
    def relocalises(self) -> bool:
        """Whether the robot is looked for in the map where another odometry begins."""
        return self.mode == "localization" or self.state_mode == "relocalise"


@dataclass(frozen=True)
class MapNodeSettings(StepSettings):
    """Parameters of ``ngo_map``."""

    resolution: float = setting(0.05, "Side of the map's cells, m.", minimum=0.005, maximum=10.0)
    max_range: float = setting(
        0.0,
        "Longest range that enters the map, m; longer rays are free up to it. 0: as far as the sensor is accurate.",
        minimum=0.0,
        maximum=1000.0,
    )
    map_update_interval: float = setting(
        0.5, "Least time between two maps, s.", minimum=0.05, maximum=3600.0, live=True
    )
    map_frame: str = frame("map", "Frame of the map, that of trajectory_topic.")
    robots: tuple[str, ...] = _robots(
        "Namespaces of several robots, as ngo_node has them: the map shows what those in map_frame saw. Empty: one "
        "robot."
    )
    trajectory_topic: str = topic("ngo/trajectory", "Corrected trajectory, from ngo_node.")
    map_topic: str = topic("map", "Map; changes of a part of it go to a topic of this name with _updates behind it.")
    save_directory: str = setting(
        "",
        "Folder in which ~/save_map and ~/save_state may write, and ~/load_state may read; empty: the working "
        "directory of the node.",
    )
    state: str = setting("", "Folder of the scans of a saved map, relative to save_directory; empty: none.")

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_robots(self)
        if self.robots and self.state:
            raise BadParameter(f"parameter 'robots' is {list(self.robots)}; allowed: none with a state")
