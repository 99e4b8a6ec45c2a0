"""The service that takes loops out of the graph: what a request means, and its answer."""

from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from ngo_msgs.srv import RemoveLoop

from ngo_estimator.nodes.messages import to_ns

if TYPE_CHECKING:  # brings torch, which takes seconds: nodes import it after checking their parameters
    from rclpy.impl.rcutils_logger import RcutilsLogger

    from ngo_estimator.nodes.file_services import Written
    from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory

_NS = 1e-9


def remove_loops(
    core: "CorrectedTrajectory",
    written: "Written | None",
    request: RemoveLoop.Request,
    response: RemoveLoop.Response,
    logger: "RcutilsLogger",
) -> bool:
    """Take out what a request names, and answer; returns whether loops are out.

    ``written``: what ids name; see ``FileServices``.
    """
    try:
        response.message, response.success = _removed(core, written, request), True
    except ValueError as error:
        response.message = str(error)
        return False
    logger.info(f"as it was told: {response.message}")
    return True


def _removed(core: "CorrectedTrajectory", written: "Written | None", request: RemoveLoop.Request) -> str:
    """Take out what a request names; returns a message for the user, or raises ``ValueError`` with one."""
    graph, trajectory = core.planar_graph(), core.trajectory()
    if graph is None or trajectory is None:
        raise ValueError("the trajectory is empty; there is no loop")
    if request.what not in (RemoveLoop.Request.LOOP, RemoveLoop.Request.STRETCH):
        raise ValueError(f"what is {request.what}; expected 0 (LOOP) or 1 (STRETCH)")
    named = ((request.first_id, request.first), (request.second_id, request.second))
    stamps_ns, ranks = trajectory.stamps_ns, core.ranks
    first, second = (
        _frame(stamps_ns, stamp) if name < 0 else _frame_of_vertex(stamps_ns, ranks, written, name)
        for name, stamp in named
    )
    stretch = request.what == RemoveLoop.Request.STRETCH
    removed = core.remove_loops(first, second, stretch)
    if removed == 0:
        joined, stamps = graph.stamps_ns[graph.edges[graph.is_loop]], stamps_ns[[first, second]]
        raise ValueError(f"no loop {'ends there' if stretch else 'joins these poses'}; {_nearest(joined, stamps)}")
    if core.fault:
        raise ValueError(f"{removed} loops are out, but {core.fault}")
    return f"{removed} loops are out; {int(graph.is_loop.sum()) - removed} stay"


def _frame_of_vertex(stamps_ns: np.ndarray, ranks: np.ndarray, written: "Written | None", name: int) -> int:
    """The frame of a vertex as it was written: since then others may have come before it, or nodes be gone."""
    if written is None:
        raise ValueError("ids are those of a saved graph; expected save_graph before, or stamps")
    of_vertices, drives = written
    if name >= len(of_vertices):
        raise ValueError(f"there is no vertex {name}; expected 0 to {len(of_vertices) - 1}")
    there = stamps_ns == of_vertices[name]
    if drives is not None:
        there &= ranks == drives[name]
    if not there.any():
        raise ValueError(f"the pose of vertex {name} is gone; expected those of a graph that is saved now")
    return int(there.argmax())


def _frame(stamps_ns: np.ndarray, stamp: Time) -> int:
    given = to_ns(stamp)
    frames = np.flatnonzero(stamps_ns == given)
    if len(frames) == 0:
        nearest = int(stamps_ns[np.abs(stamps_ns - given).argmin()])
        raise ValueError(f"no pose has the stamp {given * _NS:.9f}; the nearest one is at {nearest * _NS:.9f}")
    if len(frames) > 1:
        raise ValueError(f"{len(frames)} poses have the stamp {given * _NS:.9f}; expected an id, as save_graph has it")
    return int(frames[0])


def _nearest(joined: np.ndarray, stamps: np.ndarray) -> str:
    if len(joined) == 0:
        return "the graph has none"
    first, second = joined[np.abs(np.sort(joined, axis=1) - np.sort(stamps)).max(axis=1).argmin()].tolist()
    return f"the nearest one joins {first * _NS:.9f} and {second * _NS:.9f}"
