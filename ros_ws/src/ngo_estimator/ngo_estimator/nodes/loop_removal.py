"""The service that takes loops out of the graph: what a request means, and its answer."""

from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from ngo_msgs.srv import RemoveLoop

from ngo_estimator.nodes.messages import to_ns

if TYPE_CHECKING:  # brings torch, which takes seconds: nodes import it after checking their parameters
    from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
    from ngo_estimator.trajectory.g2o import PlanarGraph

_NS = 1e-9


def remove_loops(core: "CorrectedTrajectory", request: RemoveLoop.Request) -> str:
    """Take out what a request names; returns a message for the user, or raises ``ValueError`` with one."""
    graph, trajectory = core.planar_graph(), core.trajectory()
    if graph is None or trajectory is None:
        raise ValueError("the trajectory is empty; there is no loop")
    if request.what not in (RemoveLoop.Request.LOOP, RemoveLoop.Request.STRETCH):
        raise ValueError(f"what is {request.what}; expected 0 (LOOP) or 1 (STRETCH)")
    named = ((request.first_id, request.first), (request.second_id, request.second))
    stamps = [_stamp_ns(graph, trajectory.stamps_ns, name, stamp) for name, stamp in named]
    first, second = np.searchsorted(trajectory.stamps_ns, stamps).tolist()
    stretch = request.what == RemoveLoop.Request.STRETCH
    removed = core.remove_loops(first, second, stretch)
    if removed == 0:
        joined = graph.stamps_ns[graph.edges[graph.is_loop]]
        raise ValueError(f"no loop {'ends there' if stretch else 'joins these poses'}; {_nearest(joined, stamps)}")
    if core.fault:
        raise ValueError(f"{removed} loops are out, but {core.fault}")
    return f"{removed} loops are out; {int(graph.is_loop.sum()) - removed} stay"


def _stamp_ns(graph: "PlanarGraph", stamps_ns: np.ndarray, name: int, stamp: Time) -> int:
    if name >= 0:
        if name >= len(graph.ids):
            raise ValueError(f"there is no vertex {name}; expected 0 to {len(graph.ids) - 1}")
        return int(graph.stamps_ns[name])
    given = to_ns(stamp)
    nearest = int(stamps_ns[np.abs(stamps_ns - given).argmin()])
    if nearest != given:
        raise ValueError(f"no pose has the stamp {given * _NS:.9f}; the nearest one is at {nearest * _NS:.9f}")
    return given


def _nearest(joined: np.ndarray, stamps: list[int]) -> str:
    if len(joined) == 0:
        return "the graph has none"
    first, second = joined[np.abs(np.sort(joined, axis=1) - np.sort(stamps)).max(axis=1).argmin()].tolist()
    return f"the nearest one joins {first * _NS:.9f} and {second * _NS:.9f}"
