"""Stamps are judged by the recorder's clock, however the recorder took the messages."""

from types import SimpleNamespace

import pytest

from ngo_recordings.stamps import stamp_fault

S = 10**9


def fault(hz: float, bunch: int, pace: float, seconds: float = 6.0, stray: bool = False) -> str:
    """What is said of messages that are recorded so many at once, 50 us apart, with stamps at ``pace``."""
    messages = []
    for k in range(round(hz * seconds)):
        recorded_ns = round((k // bunch * bunch / hz + k % bunch * 5e-5) * S)
        stamp_ns = 0 if stray and not k else 5 * S + round(pace * k / hz * S)
        stamp = SimpleNamespace(sec=stamp_ns // S, nanosec=stamp_ns % S)
        value = SimpleNamespace(header=SimpleNamespace(stamp=stamp))
        messages.append(SimpleNamespace(value=value, log_time_ns=10 * S + recorded_ns))
    return stamp_fault(messages)


@pytest.mark.parametrize(("hz", "bunch"), [(10.0, 1), (400.0, 40), (50.0, 60), (20.0, 60)])
def test_messages_that_are_recorded_in_bunches_keep_their_stamps(hz: float, bunch: int) -> None:
    assert fault(hz, bunch, 1.0) == fault(hz, bunch, 1.0, stray=True) == ""
    assert fault(hz, bunch, 0.0) == "stand still"
    assert "times as fast" in fault(hz, bunch, 1000.0) and "times as fast" in fault(hz, bunch, 0.001)


@pytest.mark.parametrize("pace", [125.0, 0.01])
def test_stamps_of_a_simulation_may_run_at_any_pace(pace: float) -> None:
    assert fault(10.0, 1, pace) == ""


def test_of_less_than_a_second_nothing_is_said() -> None:
    assert fault(10.0, 1, 1000.0, seconds=0.9) == fault(10.0, 1, 1.0, seconds=0.0) == ""
