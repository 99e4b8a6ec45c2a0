"""How a simulator node runs and publishes a world, and the stamps of its frames."""

from __future__ import annotations

from dataclasses import dataclass

from ngo_common.settings import BadParameter, frame, optional_frame, setting
from ngo_sim.driver_choice import DRIVER_NAMES
from ngo_sim.paced_config import MOST, PacedConfig


@dataclass(frozen=True)
class SimulatorConfig(PacedConfig):
    """How a simulator node runs and publishes a world; the world itself has a config of its own."""

    maze_seed: int = setting(
        -1,
        "Seed of the maze and its textures alone; start, noise and driver remain those of seed. -1: seed. Not on a "
        "Doom map.",
        minimum=-1,
        maximum=MOST,
    )
    rate: float = setting(
        10.0,
        "Frames a second of wall time; 0: as fast as the subscribers take them, none lost.",
        minimum=0.0,
        maximum=10_000.0,
        live=True,
    )
    driver: str = setting(
        "auto",
        "Chooses the actions. corners: paths to the corners; random_goals: paths to random cells; distance: long "
        "straights; learned: a trained network; explorer: a driver without a map; random: random actions; none: only "
        "action_command; cmd_vel: only velocities, in maze2d; auto: corners in 2D, random_goals in 3D, explorer on a "
        "Doom map.",
        choices=("auto", *DRIVER_NAMES, "none", "cmd_vel"),
        alias="policy",
    )
    action_timeout_s: float = setting(
        0.5,
        "Wall time after the last action_command after which the driver takes over again.",
        minimum=0.0,
        maximum=3600.0,
        live=True,
    )
    cmd_vel_timeout_s: float = setting(
        0.5,
        "Simulated time after the last cmd_vel after which the robot stops, with driver cmd_vel.",
        minimum=0.05,
        maximum=10.0,
    )
    start_time_s: float = setting(
        1.0,
        "Stamp of frame 0 in simulated time; frame k has start_time_s + k period_s.",
        minimum=0.001,
        maximum=2e9,
    )
    use_wall_stamps: bool = setting(False, "Whether frames have stamps of the wall clock instead of simulated time.")
    publish_clock: bool = setting(
        False, "Whether /clock is published with the stamp of every frame; not with use_wall_stamps."
    )
    ground_truth_frame: str = frame("maze", "Frame of the ground truth: origin at the maze's corner, x along columns.")
    truth_parent_frame: str = optional_frame(
        "",
        "Parent of ground_truth_frame on /tf_static, with the robot's start as its origin. Set it to map to show the "
        "ground truth over the path of an ngo_node that takes frame 0. Empty: no transform.",
    )
    base_frame: str = frame("base_link", "Frame of the robot: child of the ground truth, frame of actions and scan.")
    camera_frame: str = frame("base_link", "Frame of image and camera_info.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.publish_clock and self.use_wall_stamps:
            raise BadParameter(
                "parameter 'publish_clock' is True; allowed: False together with use_wall_stamps, which has no "
                "simulated time"
            )
        if self.truth_parent_frame == self.ground_truth_frame:
            raise BadParameter(
                f"parameter 'truth_parent_frame' is {self.truth_parent_frame!r}; allowed: another name than "
                "ground_truth_frame's"
            )

    def stamp_ns(self, frame: int, period_s: float) -> int:
        """Simulated time of a frame in nanoseconds, from its number so that rounding errors never add up."""
        return round(self.start_time_s * 1e9) + round(frame * period_s * 1e9)
