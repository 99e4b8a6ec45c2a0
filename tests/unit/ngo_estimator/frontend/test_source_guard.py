"""Of several publishers on a topic the first is held on to."""

import pytest

from ngo_estimator.frontend.source_guard import FURTHEST_AHEAD, SourceGuard

S = 1_000_000_000


def test_a_single_publisher_may_do_what_it_likes() -> None:
    guard = SourceGuard(1.0)
    for identity, sequence, received_ns in ((1, 1, 0), (1, 5, 1), (2, 6, 2), (2, 3, 3), (1, None, 2)):
        assert guard.admits(1, identity, sequence, received_ns)


@pytest.mark.parametrize("numbered", [True, False])
def test_the_first_of_two_is_held_while_it_is_heard(numbered: bool) -> None:
    guard = SourceGuard(1.0)
    admitted = []
    for k in range(20):
        for source in ("first", "second"):
            if guard.admits(2, source, k if numbered else None, k * S // 2):
                admitted.append(source)
    assert admitted == ["first"] * 20


def test_two_of_the_same_identity_are_told_apart_by_their_counts() -> None:
    """The one that was started later counts behind, however the messages of the two interleave."""
    guard = SourceGuard(1.0)
    assert guard.admits(2, "camera", 700, 0)
    for k in range(1, 50):
        assert not guard.admits(2, "camera", k, k)
        assert guard.admits(2, "camera", 700 + 2 * k, k)
    assert not guard.admits(2, "camera", 798 + FURTHEST_AHEAD + 1, 50)


def test_another_takes_over_when_the_first_is_silent() -> None:
    guard = SourceGuard(1.0)
    assert guard.admits(2, "first", 9, 0)
    assert not guard.admits(2, "second", 1, S - 1)
    assert guard.admits(2, "second", 2, S)
    assert not guard.admits(2, "first", 10, S + 1)
