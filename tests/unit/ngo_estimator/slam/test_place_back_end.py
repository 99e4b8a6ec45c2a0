"""The graph of meta-poses repeats work the more often the less of the trajectory it saw."""

from ngo_estimator.slam.place_back_end import is_due


def test_a_short_trajectory_is_judged_anew_more_often() -> None:
    assert is_due(since=1, seen=4, every=32)
    assert not is_due(since=1, seen=8, every=32) and is_due(since=2, seen=8, every=32)
    assert not is_due(since=31, seen=1000, every=32) and is_due(since=32, seen=1000, every=32)
