"""What makes the node doubt, and what it does where the map begins anew; no process, and a clock of the test's."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import MapMetaData, OccupancyGrid
from ngo_msgs.action import Explore
from sensor_msgs.msg import LaserScan

from ngo_explorer.exploration import Exploration
from ngo_explorer.known_map import FREE, KnownMap
from ngo_explorer.nodes import world_input
from ngo_explorer.nodes.drivers import PublishedGoals
from ngo_explorer.nodes.explore_node import ExploreNode
from ngo_explorer.nodes.markers import frontier_markers
from ngo_explorer.nodes.settings import ExploreNodeSettings
from ngo_explorer.settings import ExplorerConfig

from .test_transforms import placed


class Clocked:
    """A node's input, and a clock that stands."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> None:
        self.now_s = 0.0
        monkeypatch.setattr(world_input, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.publishers, self.said = 1, []
        node: Any = SimpleNamespace(
            create_subscription=lambda *_: None,
            count_publishers=lambda _: self.publishers,
            get_logger=lambda: SimpleNamespace(warning=lambda said, once: self.said.append(said)),
        )
        self.input = world_input.WorldInput(node, ExploreNodeSettings(**settings))

    def hear(self, child: str, stamp_s: int) -> str:
        self.input._on_tf(placed("map", child, 1.0, stamp_s))
        return self.input.doubt


def test_only_its_own_new_transforms_tell_where_the_robot_is(monkeypatch: pytest.MonkeyPatch) -> None:
    world = Clocked(monkeypatch)
    assert world.hear("base_link", 7) == ""
    world.now_s = 5.0
    assert world.hear("wheel", 12) == world.hear("base_link", 7) == "there is no new pose"
    assert world.hear("base_link", 12) == ""


def test_parts_of_a_map_that_come_between_two_decisions_all_count(monkeypatch: pytest.MonkeyPatch) -> None:
    world, one, other = Clocked(monkeypatch), KnownMap(0.2, 0.6), KnownMap(0.2, 0.6)
    info = MapMetaData(width=20, height=20, resolution=0.1)
    world.input._on_map(OccupancyGrid(info=info, data=[-1] * 400))
    world.input.give_map(one)
    for x, y in ((2, 3), (10, 12), (17, 0)):
        world.input._on_update(OccupancyGridUpdate(x=x, y=y, width=2, height=4, data=[0] * 8))
        if x == 10:
            world.input.give_map(one)
            assert np.count_nonzero(one.state == FREE) == 16
    world.input.give_map(other)
    assert np.count_nonzero(other.state == FREE) == 24, "a new exploration gets the whole map"


def test_it_does_not_drive_where_no_scan_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Clocked(monkeypatch).hear("base_link", 1) == "", "drive nav2 needs no scan of ours"
    world = Clocked(monkeypatch, drive="own", scan_topic="front")
    assert world.hear("base_link", 1) == "there is no new scan on front" and not world.input.sees
    world.publishers = 0
    assert world.input.doubt == "" and "nobody publishes scans on front" in world.said[0], "it has no scanner"
    scan = LaserScan(ranges=[1.0] * 9, angle_increment=0.1, range_max=9.0)
    scan.header.frame_id = "base_link"
    world.input._on_scan(scan)
    assert world.input.doubt == "" and world.input.sees
    world.now_s = 1.1
    assert world.hear("base_link", 2) == "there is no new scan on front", "though the publisher is gone"


def test_frontiers_are_shown_where_they_were_seen_though_the_map_has_grown() -> None:
    exploration, shown = Exploration(ExplorerConfig(radius_m=0.2)), []
    for corner in (0.0, -20.0):
        values = np.full((60, 60 - 10 * int(corner)), -1, np.int8)
        values[10:50, 10 - 10 * int(corner) : 50 - 10 * int(corner)] = 0
        exploration.known.update(values, 0.1, np.array((corner, 0.0)))
        if not shown:
            exploration.decide(np.array((3.0, 3.0, 0.0)), 0.0)
        points = frontier_markers(exploration, "map", Time()).markers[1].points
        shown.append([(point.x, point.y) for point in points])
    assert shown[0] == shown[1] and np.ptp(shown[0], axis=0).max() <= 4.0


class Bare(ExploreNode):
    """The node without its communication."""

    def __init__(self, maps: list[float]) -> None:
        self._driver, self._settings, self._config = PublishedGoals(), ExploreNodeSettings(), ExplorerConfig()
        self._velocities = None
        self._input = SimpleNamespace(deviation_m=-1.0, give_map=lambda known: known.update(*self._map(maps.pop(0))))
        self._request, self._home, self._begun_s = Explore.Goal(return_to_start=True), None, 0.0
        self._renew()

    def _map(self, resolution_m: float) -> tuple[np.ndarray, float, np.ndarray]:
        return np.zeros((60, 60), np.int8), resolution_m, np.zeros(2)

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=lambda *_, **__: None)

    def _now_s(self) -> float:
        return 0.0

    def _tell(self) -> None:
        pass


def test_a_map_that_begins_anew_stops_who_drives_and_keeps_the_start() -> None:
    node = Bare([0.1, 0.05, 0.05])
    node._explore(np.array((2.0, 2.0, 0.0)))
    assert node._driver.state == "driving"
    node._explore(np.array((1.0, 1.0, 0.0)))
    assert node._pilot is None and node._driver.state == "arrived"
    node._driver.state = "driving"
    node._halt()
    assert node._driver.state == "arrived"
    node._explore(np.array((1.0, 1.0, 0.0)))
    assert node._pilot is not None
    np.testing.assert_array_equal(node._pilot._home, (2.0, 2.0, 0.0))
