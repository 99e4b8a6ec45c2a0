"""Settings of the search for loops of 2D lidar key scans."""

import math
from dataclasses import dataclass, field

from ngo_estimator.geometry.branch_and_bound import SearchConfig


@dataclass(frozen=True)
class ScanLoopConfig:
    """How loops are looked for, and which are accepted.

    Every ``every``-th key asks, at up to ``most_per_key`` places that are ``least_gap_m`` of path and more behind it.
    Places are every ``place_step``-th key, with ``submap_keys`` keys around each; ``source_keys`` keys are searched
    together, by ``search_points`` of their points. A place may be ``reach_m`` outside of the window. Positions are
    searched over ``search_factor`` times the window, so that a second peak beside it is seen. A match of places
    is searched ``match_m`` around the place. Points farther than ``range_m`` from the robot take no part in the search,
    and ``most_submaps`` submaps are kept: both bound the memory.

    A loop needs ``least_response``, at most ``most_second`` of it at another pose, ``least_on_lines`` of the points on
    lines, at most ``most_seen_through`` of the sightings through walls, and at most ``most_disagreement`` deviations
    from the graph's pose. It needs ``least_agreeing`` loops of other keys, at most ``neighbour_keys`` away at both
    ends, that agree to ``agreement_m`` and ``agreement_deg``, and ``agreeing_per_deviation`` for each deviation from
    the graph's pose: the more a loop would change, the more of them.
    """

    search: SearchConfig = field(default_factory=SearchConfig)
    every: int = 2
    most_per_key: int = 3
    least_gap_m: float = 8.0
    place_step: int = 5
    submap_keys: int = 15
    source_keys: int = 4
    search_points: int = 300
    reach_m: float = 2.0
    search_factor: float = 2.0
    match_m: float = 4.0
    range_m: float = 20.0
    most_submaps: int = 24
    least_response: float = 0.55
    most_second: float = 0.9
    least_on_lines: float = 0.6
    most_seen_through: float = 0.15
    most_disagreement: float = 3.0
    least_agreeing: int = 1
    agreeing_per_deviation: float = 2.0
    neighbour_keys: int = 12
    agreement_m: float = 0.25
    agreement_deg: float = 4.0

    def __post_init__(self) -> None:
        for name in ("every", "place_step", "submap_keys", "source_keys", "search_points", "most_submaps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 1")
        for name in ("most_per_key", "least_agreeing", "neighbour_keys"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 0")
        shares = (self.least_response, self.most_second, self.least_on_lines, self.most_seen_through)
        if not all(0.0 <= x <= 1.0 for x in shares):
            raise ValueError(
                "least_response, most_second, least_on_lines, most_seen_through are "
                f"{shares}; expected shares from 0 to 1"
            )
        lengths = (
            self.least_gap_m, self.reach_m, self.match_m, self.range_m, self.agreement_m, self.agreement_deg
        )  # fmt: skip
        if not all(0.0 <= x < math.inf for x in lengths):
            raise ValueError(
                f"least_gap_m, reach_m, match_m, range_m, agreement_m, agreement_deg are {lengths}; expected finite "
                "numbers from 0 on"
            )
        if not 1.0 <= self.search_factor < math.inf:
            raise ValueError(f"search_factor is {self.search_factor}; expected a finite number of at least 1")
        if not (self.most_disagreement >= 0.0 and 0.0 <= self.agreeing_per_deviation < math.inf):
            raise ValueError(
                f"most_disagreement, agreeing_per_deviation are {self.most_disagreement}, "
                f"{self.agreeing_per_deviation}; expected numbers from 0 on, the second finite"
            )
        if self.source_keys > self.submap_keys:
            raise ValueError(
                f"source_keys, submap_keys are {self.source_keys}, {self.submap_keys}; expected no more in the source"
            )
