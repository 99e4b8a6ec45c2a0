"""A search that fails costs itself alone."""

from typing import Any

import numpy as np

from ngo_estimator.graph.meta_nodes import MetaNodes
from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.slam.block_intake import BlockIntake


class Recorded:
    """Stands for the odometry and the loops, and records what is asked of them."""

    std = None

    def __init__(self, fails: str = "") -> None:
        self.asked, self._fails = list[str](), fails

    def _take(self, name: str) -> PlaceLoops:
        self.asked.append(name)
        if name == self._fails:
            raise ArithmeticError("no\nnumber")
        return PlaceLoops.none()

    def aggregate(self, block: int) -> None:
        self._take("aggregate")

    def look(self, *given: Any) -> None:
        self._take("look")

    def measure(self) -> PlaceLoops:
        return self._take("measure")

    def find_overlaps(self, *given: Any) -> PlaceLoops:
        return self._take("overlaps")


def intake(recorded: Any, blocks: int = 1, overlaps: bool = True) -> BlockIntake:
    nodes = MetaNodes(2)
    for _ in range(blocks):
        nodes.append(np.zeros(3), np.zeros((3, 3)))
        nodes.add_node()
    return BlockIntake(recorded, nodes, recorded, overlaps, 1.0)


def test_searches_follow_the_features_in_their_order() -> None:
    recorded = Recorded()
    assert intake(recorded).take() == ""
    assert recorded.asked == ["aggregate", "look", "measure", "overlaps"]


def test_what_fails_is_said_in_a_line_and_the_rest_is_done() -> None:
    recorded = Recorded(fails="look")
    assert intake(recorded, overlaps=False).take() == "the search for loops failed, ArithmeticError: no number"
    assert recorded.asked == ["aggregate", "look", "measure"]


def test_overlaps_are_looked_for_under_fresh_poses_alone() -> None:
    recorded = Recorded()
    intake(recorded, blocks=3).take()
    assert "overlaps" not in recorded.asked
