"""How often something is published."""

import pytest

from ngo_estimator.slam.publication_pace import PublicationPace


def publications(rate_hz: float, offered_s: list[float], took_s: float) -> list[float]:
    """When something that is offered at these times is published."""
    pace, published = PublicationPace(rate_hz), []
    for now_s in offered_s:
        if pace.is_due(now_s):
            published.append(now_s)
            pace.published(now_s, now_s + took_s)
    return published


def test_the_first_comes_at_once_and_then_at_most_at_the_rate() -> None:
    offered = [0.0625 * k for k in range(33)]
    assert publications(4.0, offered, 0.001) == [0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0]


def test_what_takes_long_comes_more_seldom() -> None:
    """A tenth of all time at most: 45 ms every 450 ms."""
    assert publications(10.0, [0.25 * k for k in range(9)], 0.045) == [0.0, 0.5, 1.0, 1.5, 2.0]


def test_a_rate_of_zero_lets_everything_pass() -> None:
    offered = [0.001 * k for k in range(10)]
    assert publications(0.0, offered, 5.0) == offered


@pytest.mark.parametrize("rate_hz", [-1.0, float("nan"), float("inf")])
def test_a_rate_that_cannot_be_is_refused(rate_hz: float) -> None:
    with pytest.raises(ValueError, match="expected 0 or more"):
        PublicationPace(rate_hz)


def test_equal_publishers_have_parts_of_the_share() -> None:
    pace = PublicationPace(10.0, equals=4)
    pace.published(100.0, 100.1)
    assert not pace.is_due(103.9) and pace.is_due(104.1)
