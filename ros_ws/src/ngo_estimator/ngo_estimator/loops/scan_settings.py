"""All settings of a lidar's back end: where loops are looked for, which are believed, and when all is optimised."""

import math
from dataclasses import dataclass, field

from ngo_estimator.data.configuration import check
from ngo_estimator.geometry.branch_and_bound import SearchConfig


@dataclass(frozen=True)
class ScanLoopConfig:
    """How loops are looked for, and which are accepted."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """Branch and bound, by which a key scan is searched in a submap."""

    every: int = 2  # Of so many key scans one asks for loops.
    most_per_key: int = 3  # Places at most at which it asks.
    least_gap_m: float = 8.0  # Path at least between a place and the key scan (m).
    place_step: int = 5  # Of so many key scans one is a place.
    submap_keys: int = 15  # Key scans of a place's submap, around the place.
    source_keys: int = 4  # Newest key scans that are searched together; no more than ``submap_keys``.
    search_points: int = 300  # Points of them at most by which they are searched; all points are registered.
    reach_m: float = 2.0  # How far outside of the window a place may be (m).
    search_factor: float = 2.0
    """Positions are searched in the window times this, at least 1, so that a second peak beside it is seen."""
    range_m: float = 20.0
    """Distance from the robot up to which points take part in the search (m); it bounds the memory."""
    most_submaps: int = 24  # Submaps that are kept; it bounds the memory.

    least_response: float = 0.55  # Mean likelihood of the points at least, 0 to 1.
    most_second: float = 0.9  # Second peak at most, as a part of the first, 0 to 1.
    least_on_lines: float = 0.6  # Inlier ratio at least: of the points those on lines of the submap, 0 to 1.
    most_seen_through: float = 0.15  # Share at most of the sightings that lead through walls, 0 to 1.
    most_disagreement: float = 3.0  # Distance at most from the graph's pose (deviations).
    agreeing_per_deviation: float = 2.0
    """Loops of other keys nearby that must agree, for each deviation from the graph's pose: the more a loop would
    change, the more must agree."""
    neighbour_keys: int = 12  # Keys at both ends up to which a loop is nearby.
    agreement_m: float = 0.25  # Difference of positions at which loops still agree (m).
    agreement_deg: float = 4.0  # Difference of headings at which they still do (degrees).

    def __post_init__(self) -> None:
        counts = "every place_step submap_keys source_keys search_points most_submaps"
        check(self, counts, "at least 1", lambda x: x >= 1)
        check(self, "most_per_key neighbour_keys", "at least 0", lambda x: x >= 0)
        ratios = "least_response most_second least_on_lines most_seen_through"
        check(self, ratios, "a ratio from 0 to 1", lambda x: 0.0 <= x <= 1.0)
        lengths = "least_gap_m reach_m range_m agreement_m agreement_deg agreeing_per_deviation"
        check(self, lengths, "a finite number from 0 on", lambda x: 0.0 <= x < math.inf)
        check(self, "search_factor", "a finite number of at least 1", lambda x: 1.0 <= x < math.inf)
        check(self, "most_disagreement", "a number from 0 on", lambda x: x >= 0.0)
        check(self, "source_keys", f"at most submap_keys, {self.submap_keys}", lambda x: x <= self.submap_keys)


@dataclass(frozen=True)
class WindowConfig:
    """How far a pose may be from where the graph has it: loops are searched that far."""

    least_m: float = 0.3  # Half width of the window where the graph is sure (m).
    most_m: float = 8.0  # Half width at most (m).
    least_deg: float = 8.0  # Half width in heading where the graph is sure (degrees).
    most_deg: float = 45.0  # Half width in heading at most (degrees), up to 180.
    deviations: float = 3.0  # What the graph's covariance adds to both (deviations).

    def __post_init__(self) -> None:
        check(self, "least_m", f"a positive number up to most_m, {self.most_m}", lambda x: 0.0 < x <= self.most_m)
        check(self, "most_m", "a finite number", math.isfinite)
        check(self, "least_deg", f"positive, up to most_deg, {self.most_deg}", lambda x: 0.0 < x <= self.most_deg)
        check(self, "most_deg", "at most 180", lambda x: x <= 180.0)
        check(self, "deviations", "a positive number", lambda x: x > 0.0)


@dataclass(frozen=True)
class ScanGraphConfig:
    """How key scans are optimised."""

    loops: ScanLoopConfig = field(default_factory=ScanLoopConfig)  # How loops are looked for, and which are accepted.
    windows: WindowConfig = field(default_factory=WindowConfig)  # How far from the graph's poses they are looked for.

    keys_between: int = 8  # Key scans since the last optimisation for which a new loop waits, at least 1.
    surprise: float = 3.0
    """How far a new loop is off the graph that does not wait (deviations), and is needed in any case."""
    surprise_m: float = 0.06  # The same at the walls (m); it must be off by both.
    redundant: float = 15.0  # A loop is left out where a path through the graph has at most so many times its variance.
    agreeing_beyond: int = 8  # Loops that must agree with one where the robot may be outside of the widest window.
    kernel: float = 3.0  # Width of the Cauchy kernel that softens the covariance of the newest pose (deviations).
    step_m: float = 0.005
    """Deviation added to each step's position (m): registration in the same few key scans does not see it."""
    step_deg: float = 0.15  # Deviation added to each step's heading (degrees).
    most_scans: int = 4000
    """Key scans from which on, at least 100, old ones leave the graph where newer ones show the same. Poses stay."""

    def __post_init__(self) -> None:
        check(self, "keys_between", "at least 1", lambda x: x >= 1)
        check(self, "most_scans", "at least 100", lambda x: x >= 100)
        check(self, "agreeing_beyond", "at least 0", lambda x: x >= 0)
        positive = "surprise surprise_m redundant kernel step_m step_deg"
        check(self, positive, "a positive number", lambda x: 0.0 < x < math.inf)
