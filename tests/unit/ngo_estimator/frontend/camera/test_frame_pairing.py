"""Frames and actions in any order of arrival: each frame gets its action, or is dropped and counted."""

import numpy as np
import pytest

from ngo_estimator.frontend.camera.frame_pairing import FramePairing
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame

STEP_NS = 100_000_000
IMAGE = np.zeros((1, 8, 4), np.float32)


def make(needs_action: bool = True, timeout_ns: int = 10 * STEP_NS, capacity: int = 64) -> FramePairing:
    return FramePairing(needs_action, timeout_ns, capacity)


def play(pairing: FramePairing, *events: str) -> list[tuple[int, int | None]]:
    """Feed `f3` (frame of step 3) and `a3` (its action, of value 3); return the (step, action) handed out."""
    result = []
    for event in events:
        step = int(event[1:])
        if event[0] == "f":
            pairing.add_frame(step * STEP_NS, IMAGE)
        else:
            pairing.add_action(step * STEP_NS, step)
        result += [(pair.stamp_ns // STEP_NS, pair.action) for pair in pairing.ready()]
    return result


@pytest.mark.parametrize("order", ["f0 a0 f1 a1 f2", "f0 f1 a0 f2 a1", "f0 f1 f2 a0 a1", "a0 a1 f0 f1 f2"])
def test_every_order_of_arrival_gives_the_same_pairs(order: str) -> None:
    pairing = make()
    assert play(pairing, *order.split()) == [(0, None), (1, 0), (2, 1)]
    assert pairing.dropped == pairing.waiting == 0


def test_a_frame_waits_for_its_action() -> None:
    pairing = make()
    assert play(pairing, "f0", "f1") == [(0, None)]
    assert pairing.waiting == 1
    assert play(pairing, "a0") == [(1, 0)]


def test_without_need_of_actions_frames_pass() -> None:
    assert play(make(needs_action=False), "f0", "f1", "f2") == [(0, None), (1, None), (2, None)]


def test_after_a_lost_frame_the_action_of_the_older_frame_counts() -> None:
    assert play(make(), "f0", "a0", "a1", "f2", "a2", "f3") == [(0, None), (2, 0), (3, 2)]


def test_a_lost_action_drops_its_frame_and_nothing_else() -> None:
    pairing = make()
    assert play(pairing, "f0", "a0", "f1", "f2", "a2", "f3", "a3", "f4") == [
        (0, None),
        (1, 0),
        (3, 2),
        (4, 3),
    ]
    assert pairing.dropped == 1


def test_frames_without_any_action_are_dropped_after_the_timeout_in_stamps() -> None:
    pairing = make(timeout_ns=3 * STEP_NS)
    assert play(pairing, *[f"f{step}" for step in range(10)]) == [(0, None)]
    assert (pairing.dropped, pairing.waiting) == (6, 3)


def test_no_more_frames_wait_than_the_capacity() -> None:
    pairing = make(capacity=4)
    assert play(pairing, *[f"f{step}" for step in range(9)]) == [(0, None)]
    assert (pairing.dropped, pairing.waiting) == (4, 4)


def test_repeated_and_late_frames_are_errors_and_change_nothing() -> None:
    pairing = make()
    play(pairing, "f0", "a0", "f2", "f3")
    with pytest.raises(DuplicateFrame):
        play(pairing, "f3")
    with pytest.raises(LateFrame, match=r"0\.200 s older"):
        play(pairing, "f1")
    assert play(pairing, "a2") == [(3, 2)]


@pytest.mark.parametrize("order", ["f0 a0 f1", "a0 f0 f1", "a0 a1 f0 f1 f2 a2", "f0 f1 a0"])
def test_a_restarted_source_starts_anew_in_every_order(order: str) -> None:
    pairing = make()
    play(pairing, "f50", "a50", "f51", "a51", "f52", "f53")
    result = play(pairing, *order.split())
    assert result[:2] == [(0, None), (1, 0)]
    assert pairing.dropped == 1  # f53, which waited for its action
    assert pairing.waiting == 0


def play_twists(pairing: FramePairing, *events: str) -> list[tuple[int, float | None]]:
    """Feed `f3` (frame of step 3) and `t2.5=7` (velocity 7 m/s stamped in step 2.5); return (step, m/s) handed out."""
    result = []
    for event in events:
        if event[0] == "f":
            pairing.add_frame(int(float(event[1:]) * STEP_NS), IMAGE)
        else:
            when, speed = event[1:].split("=")
            pairing.add_twist(int(float(when) * STEP_NS), np.array([float(speed), 0.0, 0.0]))
        ready = list(pairing.ready())
        result += [(pair.stamp_ns // STEP_NS, None if pair.twist is None else float(pair.twist[0])) for pair in ready]
    return result


def make_for_twists(**changes: int) -> FramePairing:
    settings = {"timeout_ns": 10 * STEP_NS, "capacity": 64, "twist_tolerance_ns": 5 * STEP_NS, **changes}
    return FramePairing(False, needs_twist=True, **settings)


@pytest.mark.parametrize(
    "order", ["f0 t0.5=1 f1 t1=3 t1.2=9", "t0=7 t0.5=1 t1=3 t1.2=9 f0 f1", "f0 f1 t0=7 t0.5=1 t1=3"]
)
def test_a_step_gets_the_mean_velocity_stamped_in_it(order: str) -> None:
    assert play_twists(make_for_twists(), *order.split()) == [(0, None), (1, 2.0)]


def test_a_velocity_that_comes_rarely_holds_until_the_next_one() -> None:
    pairing = make_for_twists()
    assert play_twists(pairing, "t0=4", "f0", "f1", "f2", "f3", "t3.5=6") == [(0, None), (1, 4.0), (2, 4.0), (3, 4.0)]
    assert pairing.dropped == 0


def test_a_velocity_that_stays_away_drops_the_frames_that_it_is_too_old_for() -> None:
    pairing = make_for_twists(timeout_ns=2 * STEP_NS)
    handed_out = play_twists(pairing, "t0=4", *(f"f{k}" for k in range(10)))
    assert handed_out == [(0, None), *((k, 4.0) for k in range(1, 6))] and pairing.dropped == 2
    assert play_twists(pairing, "t9=8") == [(9, 8.0)] and pairing.dropped == 3
