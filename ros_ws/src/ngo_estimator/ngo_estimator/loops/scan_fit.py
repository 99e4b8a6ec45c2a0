"""Scans searched in a submap by branch and bound (Hess et al. 2016, section V), then registered (Censi 2008).

A pose is believed where points lie on lines, no wall is seen through, and no other pose fits nearly
as well. No fit is better than a wrong one.
"""

import numpy as np

from ngo_estimator.geometry.branch_and_bound import search
from ngo_estimator.geometry.scan_matching import Registration, icp
from ngo_estimator.loops.key_scan_views import one_a_cell, within
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.loops.scan_submaps import Submap
from ngo_estimator.loops.walls_seen_through import PlacedScans, seen_through


def fit(
    config: ScanLoopConfig, submap: Submap, source: PlacedScans, centre: np.ndarray, window: np.ndarray
) -> tuple[Registration, tuple[float, ...]] | None:
    """How a source lies in a submap, with the first four of ``EVIDENCE``; None where a test fails.

    It is searched at ``centre`` plus and minus ``window``, both ``(3,)`` (m, m, rad).
    """
    chosen = search_points(config, source)
    if submap.grid is None or len(chosen) == 0:
        return None
    match = search(config.search, submap.grid, chosen, centre, window)
    if match is None or match.response < config.least_response:
        return None
    second_peak = match.second / match.response
    if second_peak > config.most_second:
        return None
    registered = icp(submap.lines, source.points, source.normals, match.pose)
    if registered.share < config.least_on_lines:
        return None
    through = seen_through(submap.scans, source, registered.pose)
    if through > config.most_seen_through:
        return None
    return registered, (match.response, second_peak, registered.share, through)


def search_points(config: ScanLoopConfig, source: PlacedScans) -> np.ndarray:
    """Some points ``(n, 2)`` of a source, by which it is searched."""
    return _spread(within(source.points, config.range_m), config.search.resolution_m, config.search_points)


def _spread(points: np.ndarray, cell_m: float, most: int) -> np.ndarray:
    """One point ``(n, 2)`` of each cell, and of these every so many that at most ``most`` remain."""
    chosen = points[one_a_cell(points, cell_m)]
    return chosen[np.linspace(0, len(chosen) - 1, most).astype(np.int64)] if len(chosen) > most else chosen
