"""Localisation in a fixed map: right where places are unique, silent where they are not, and lost when contradicted."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.slam.evidence import Hypotheses, HypothesisWindow, fused, strongest_modes
from ngo_estimator.slam.localisation import Localisation, LocalisationConfig, Localiser
from ngo_estimator.slam.sightings import Sightings

STEP = np.array((0.3, 0.02, 0.05))
COVARIANCE = np.diag((0.01, 0.01, 0.005)) ** 2
SEEN = np.diag((0.05, 0.05, 0.01)) ** 2
NOTHING = np.zeros(0, np.float32)


class Map:
    """A map that sees the robot where it truly is, and also where ``copies`` (n, 3) of the map say."""

    place_m = 1.0
    look_m = 0.4
    search_every = 1

    def __init__(self, copies: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),), seed: int = 0) -> None:
        self.copies, self.pose, self.blind = [np.array(copy) for copy in copies], np.zeros(3), False
        self._random = np.random.default_rng(seed)
        self.asked = 0
        self.clear: list[np.ndarray] = []  # of the copies
        self.allowing = True

    def append(self, step: RelativeStep, odometry: np.ndarray) -> bool:
        return True

    def reset(self) -> None:
        pass

    def everywhere(self) -> Sightings:
        self.asked += 1
        if self.blind:
            return Sightings.none()
        noise = self._random.normal(0.0, (0.03, 0.03, 0.005), (len(self.copies), 3))
        poses = np.stack([compose(copy, self.pose) for copy in self.copies]) + noise
        return Sightings(poses, np.stack([SEEN] * len(poses)), np.full(len(poses), 0.9))

    def around(self, expected: np.ndarray) -> Sightings:
        return Sightings.none()

    def is_clear(self, pose: np.ndarray) -> bool:
        return any(math.dist(pose[:2], compose(copy, self.pose)[:2]) < 0.5 for copy in self.clear)

    def allows(self, pose: np.ndarray) -> bool:
        return self.allowing


class Anywhere(Map):
    """A map whose hypotheses have nothing to do with each other."""

    def everywhere(self) -> Sightings:
        poses = self._random.uniform(-10.0, 10.0, (8, 3))
        return Sightings(poses, np.stack([SEEN] * 8), np.full(8, 0.9))


def drive(localiser: Localiser, at: Map, steps: int, start: np.ndarray | None = None) -> Iterator[Localisation]:
    if start is not None:
        at.pose = start
    for _ in range(steps):
        at.pose = compose(at.pose, STEP)
        yield step(localiser)


def step(localiser: Localiser, relative: np.ndarray = STEP) -> Localisation:
    whole = RelativeStep(2, 1, relative, COVARIANCE, 0, relative, NOTHING, NOTHING)
    return localiser.update(whole, relative, COVARIANCE)


def off(found: Localisation, at: Map) -> tuple[float, float]:
    assert found.pose_xyyaw is not None
    x, y, yaw = between(at.pose, found.pose_xyyaw)
    return math.hypot(x, y), abs(yaw)


def test_a_start_in_the_middle_of_the_map_is_found_and_followed() -> None:
    at = Map()
    localiser = Localiser(at)
    found = list(drive(localiser, at, 40, np.array((5.0, -3.0, 2.0))))
    known = [k for k, one in enumerate(found) if one.pose_xyyaw is not None]
    # Seven looks' support of 0.9 each is eight looks; a look takes two steps of 0.3 m.
    assert 8 < known[0] < 20 and known == list(range(known[0], 40))
    assert [k for k, one in enumerate(found) if one.claimed] == known[:1] and not any(one.lost for one in found)
    metres, radians = off(found[-1], at)
    assert metres < 0.05 and radians < 0.02
    assert found[-1].covariance is not None and (np.linalg.eigvalsh(found[-1].covariance) > 0.0).all()
    assert np.sqrt(found[-1].covariance[0, 0]) < 0.05


def test_one_look_is_enough_where_the_way_is_clear_and_none_where_places_look_alike() -> None:
    first = {}
    for clear in (True, False):
        at = Map()
        at.clear = at.copies if clear else []
        first[clear] = [one.claimed for one in drive(Localiser(at), at, 40)].index(True)
    assert first[True] == 0 and 7 < first[False] < 20
    at = Map()
    at.clear = at.copies
    localiser = Localiser(at)
    localiser.take_time()
    assert [one.claimed for one in drive(localiser, at, 40)].index(True) == first[False]
    at = Map()
    at.allowing = False
    assert not any(one.claimed for one in drive(Localiser(at), at, 60))


@pytest.mark.parametrize("clear", [0, 1])
def test_of_two_places_the_one_where_the_way_is_clear_is_claimed(clear: int) -> None:
    at = Map(((0.0, 0.0, 0.0), (8.0, 1.0, 0.0)))
    at.clear = at.copies[clear : clear + 1]
    found = next(one for one in drive(Localiser(at), at, 40) if one.claimed)
    assert found.pose_xyyaw is not None
    np.testing.assert_allclose(found.pose_xyyaw[:2], compose(at.copies[clear], at.pose)[:2], atol=0.2)
    at.clear = list(at.copies)
    localiser = Localiser(at)
    list(drive(localiser, at, 4))
    at.copies.pop()  # now the other one alone is seen
    assert not any(one.claimed for one in drive(localiser, at, 30))


def test_a_clear_way_at_a_place_with_fewer_sightings_than_another_is_no_claim() -> None:
    at = Map(((0.0, 0.0, 0.0),))
    localiser = Localiser(at)
    list(drive(localiser, at, 6))  # sees one place alone
    at.copies.append(np.array((8.0, 1.0, 0.0)))
    at.clear = at.copies[1:]
    assert not any(one.claimed for one in drive(localiser, at, 8))


@pytest.mark.parametrize("copy", [(8.0, 1.0, 0.0), (0.0, 0.0, math.pi), (3.0, 0.0, math.pi / 2.0)])
def test_an_ambiguous_map_is_never_claimed(copy: tuple[float, float, float]) -> None:
    at = Map(((0.0, 0.0, 0.0), copy))
    found = list(drive(Localiser(at), at, 80))
    assert all(one.pose_xyyaw is None and not one.claimed for one in found)
    assert len(found[-1].hypotheses) >= 2 and found[-1].hypotheses[1].support > 7.0


def test_what_disagrees_is_never_claimed_nor_what_is_seen_by_one_frame() -> None:
    at = Anywhere()
    assert all(one.pose_xyyaw is None for one in drive(Localiser(at), at, 200))


def test_a_robot_that_stands_or_turns_on_the_spot_does_not_gather_evidence() -> None:
    at = Map()
    localiser = Localiser(at)
    assert all(step(localiser, np.zeros(3)).pose_xyyaw is None for _ in range(50)) and at.asked == 1
    for _ in range(60):
        turn = np.array((0.0, 0.0, 0.2))
        at.pose = compose(at.pose, turn)
        assert step(localiser, turn).pose_xyyaw is None


def test_an_ambiguity_that_ends_ends_in_the_right_claim() -> None:
    at = Map(((0.0, 0.0, 0.0), (8.0, 1.0, 0.0)))
    localiser = Localiser(at)
    assert all(one.pose_xyyaw is None for one in drive(localiser, at, 40))
    at.copies.pop()
    found = list(drive(localiser, at, 60))
    assert found[-1].pose_xyyaw is not None and off(found[-1], at)[0] < 0.05


def test_a_robot_that_is_carried_away_is_lost_and_found_again() -> None:
    at = Map()
    localiser = Localiser(at)
    assert list(drive(localiser, at, 30))[-1].pose_xyyaw is not None
    found = list(drive(localiser, at, 60, np.array((-20.0, 4.0, 1.0))))
    lost = [k for k, one in enumerate(found) if one.lost]
    claimed = [k for k, one in enumerate(found) if one.claimed]
    assert len(lost) == 1 and len(claimed) == 1 and lost[0] < claimed[0]
    assert off(found[-1], at)[0] < 0.05


def test_without_sightings_the_odometry_carries_the_pose_until_it_says_nothing_any_more() -> None:
    at = Map()
    localiser = Localiser(at)
    list(drive(localiser, at, 30))
    at.blind = True
    found = list(drive(localiser, at, 20))
    assert all(one.pose_xyyaw is not None for one in found) and off(found[-1], at)[0] < 0.2
    deviations = [
        np.sqrt(np.linalg.eigvalsh(one.covariance[:2, :2])[-1]) for one in found if one.covariance is not None
    ]
    assert (np.diff(deviations) > 0.0).all()
    found = list(drive(localiser, at, 3000))
    assert [one.lost for one in found].count(True) == 1 and found[-1].pose_xyyaw is None


def test_a_pose_that_is_told_holds_at_once_and_a_wrong_one_is_found_out() -> None:
    at = Map()
    localiser = Localiser(at)
    localiser.set_pose(np.zeros(3), np.diag((0.2, 0.2, 0.05)))
    (found,) = drive(localiser, at, 1)
    assert found.pose_xyyaw is not None and off(found, at)[0] < 0.1
    localiser.set_pose(np.array((15.0, 0.0, 0.0)), np.diag((0.2, 0.2, 0.05)))
    later = list(drive(localiser, at, 60))
    assert off(later[0], at)[0] > 10.0 and any(one.lost for one in later) and off(later[-1], at)[0] < 0.05


def test_a_told_pose_settles_an_ambiguity() -> None:
    at = Map(((0.0, 0.0, 0.0), (8.0, 1.0, 0.0)))
    localiser = Localiser(at)
    localiser.set_pose(at.pose, np.diag((0.2, 0.2, 0.05)))
    found = list(drive(localiser, at, 60))
    assert all(one.pose_xyyaw is not None for one in found) and off(found[-1], at)[0] < 0.05


def test_two_robots_that_see_the_same_say_the_same_to_the_last_bit() -> None:
    def poses() -> list[bytes]:
        at = Map(seed=3)
        found = drive(Localiser(at), at, 60, np.array((1.0, 2.0, 3.0)))
        return [one.pose_xyyaw.tobytes() for one in found if one.pose_xyyaw is not None]

    assert poses() == poses() and len(poses()) > 40


def test_a_reset_forgets_the_pose() -> None:
    at = Map()
    localiser = Localiser(at)
    list(drive(localiser, at, 30))
    localiser.reset()
    (found,) = drive(localiser, at, 1)
    assert found.pose_xyyaw is None and len(found.hypotheses) == 1


def test_sightings_are_carried_along_by_hand() -> None:
    window = HypothesisWindow(2)
    for x in (1.0, 2.0, 3.0):
        window.add(Sightings(np.array(((x, 0.0, math.pi / 2.0),)), SEEN[None], np.ones(1)))
        window.move(np.array((1.0, 0.0, 0.0)), COVARIANCE)
    # The first is forgotten; those at x = 2 and 3 look along y, and went 2 m and 1 m.
    found = window.hypotheses()
    assert found.poses == pytest.approx(np.array(((2.0, 2.0, math.pi / 2.0), (3.0, 1.0, math.pi / 2.0))))
    # Variances: of the sighting, of the steps, and of headings over the way behind them.
    assert found.covariance[1][0, 0] == pytest.approx(0.05**2 + 0.01**2 + 0.01**2)
    assert found.look.tolist() == [0, 1] and window.way_m.tolist() == [2.0, 1.0]


def test_modes_count_each_look_once() -> None:
    poses = np.array(((0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (9.0, 0.0, 0.0)))
    belief, look = np.array((0.5, 0.9, 0.8, 1.0)), np.array((0, 0, 1, 1))
    first, second = strongest_modes(Hypotheses(poses, np.stack([SEEN] * 4), belief, look), 1.0)
    assert first.support == pytest.approx(1.7) and first.looks.tolist() == [0, 1]
    assert second.support == pytest.approx(1.0) and second.pose_xyyaw.tolist() == [9.0, 0.0, 0.0]


def test_equal_sightings_of_two_looks_fuse_to_their_middle_across_half_a_turn() -> None:
    poses = np.array(((1.0, 0.0, math.pi - 0.01), (1.0, 0.0, -math.pi + 0.01)))
    hypotheses = Hypotheses(poses, np.stack([SEEN, SEEN]), np.ones(2), np.array((0, 1)))
    pose, covariance = fused(hypotheses, poses[0])
    assert pose[0] == pytest.approx(1.0) and abs(abs(pose[2]) - math.pi) < 1e-4
    assert 0.5 * SEEN[0, 0] <= covariance[0, 0] < 0.7 * SEEN[0, 0]


@pytest.mark.parametrize("changed", [{"window": 1}, {"most_rival": 1.0}, {"least_support": 0.0}, {"least_share": 2.0}])
def test_impossible_settings_are_refused(changed: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(changed))):
        LocalisationConfig(**changed)  # type: ignore[arg-type]
