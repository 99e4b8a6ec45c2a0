"""The settings of the core, one line each."""

from dataclasses import dataclass

from ngo_common.settings import Settings, setting

RULES = ("gain_distance", "random", "nearest", "explore_lite", "d_optimality")


@dataclass(frozen=True)
class ExplorerConfig(Settings):
    """What the robot is, what a frontier is, and how the next one is chosen."""

    rule: str = setting(
        "gain_distance",
        "Chooses the next frontier. gain_distance: most unknown area a metre; random; nearest: shortest path; "
        "explore_lite: 3 x distance - size, as that package; d_optimality: of the predicted pose graph.",
        choices=RULES,
    )
    radius_m: float = setting(0.22, "Radius of the robot, m.", minimum=0.02, maximum=2.0)
    margin_m: float = setting(0.05, "Least distance that paths keep from obstacles beside the radius, m.", minimum=0.0)
    comfort_m: float = setting(0.6, "Distance from obstacles below which paths cost more, m.", minimum=0.0, maximum=3.0)
    reach_m: float = setting(6.0, "Longest distance to look at a frontier from: what the robot sees, m.", minimum=0.3)
    frontier_m: float = setting(0.75, "Length of the smallest frontier, m.", minimum=0.0, maximum=10.0)
    gain_m2: float = setting(0.1, "Unknown area that a frontier must show from its viewpoint, m^2.", minimum=0.0)
    gain_range_m: float = setting(4.0, "Distance beyond a frontier up to which unknown area is gain, m.", minimum=0.3)
    replan_s: float = setting(2.0, "Time between two decisions on the way, s.", minimum=0.1, maximum=600.0)
    progress_s: float = setting(15.0, "Time without progress after which a goal is put aside, s.", minimum=1.0)
    wait_s: float = setting(300.0, "Time that it waits in all for ways that shut, s.", minimum=0.0, maximum=86400.0)

    def need_m(self, resolution_m: float) -> float:
        """Clearance that a cell of a map needs for the robot's middle."""
        # Two points in cells may be nearer than the cells' middles by a cell's diagonal; half of it is usual.
        return self.radius_m + self.margin_m + 0.5 * resolution_m

    @property
    def touch_m(self) -> float:
        """Distance from what a scan shows at which the robot stops: half of the margin is left."""
        return self.radius_m + 0.5 * self.margin_m


@dataclass(frozen=True)
class DriveConfig(Settings):
    """How the robot follows a path."""

    speed_mps: float = setting(0.6, "Highest speed, m/s.", minimum=0.01, maximum=5.0)
    turn_rate_rps: float = setting(1.0, "Highest turn rate, rad/s.", minimum=0.05, maximum=6.0)
    acceleration_mps2: float = setting(0.5, "Highest acceleration, m/s^2.", minimum=0.05, maximum=10.0)
    turn_acceleration_rps2: float = setting(2.0, "Highest turn acceleration, rad/s^2.", minimum=0.1, maximum=30.0)
    arrived_m: float = setting(0.15, "Distance at which a goal is reached, m.", minimum=0.01, maximum=2.0)
    stuck_s: float = setting(4.0, "Time without motion after which the robot backs up, s.", minimum=0.5, maximum=60.0)
