import pytest

from ngo_sim.flow_control import FlowControl, Pacer


def publish(flow: FlowControl, *stamps: int) -> None:
    for stamp in stamps:
        assert flow.may_publish()
        flow.published(stamp)


def test_stays_max_in_flight_ahead_of_the_newest_stamp() -> None:
    flow = FlowControl(max_in_flight=2)
    flow.set_topics(["odom"])
    publish(flow, 0, 10, 20)  # the first is for free: motion has no answer to it
    assert not flow.may_publish()
    flow.seen("odom", 10)
    publish(flow, 30)
    assert flow.in_flight() == 2 and not flow.may_publish()
    flow.seen("odom", 30)
    assert flow.in_flight() == 0


def test_the_slowest_of_several_counts() -> None:
    flow = FlowControl(max_in_flight=3)
    flow.set_topics(["odom", "ngo/pose"])
    publish(flow, 0, 1, 2)
    flow.seen("odom", 2)
    assert flow.in_flight() == 2
    flow.seen("ngo/pose", 1)
    assert flow.in_flight() == 1
    assert flow.waiting_for() == ["ngo/pose"]


def test_a_frame_that_was_skipped_is_finished_with_a_later_one() -> None:
    flow = FlowControl(max_in_flight=4)
    flow.set_topics(["odom"])
    publish(flow, 0, 1, 2, 3)
    flow.seen("odom", 3)
    assert flow.in_flight() == 0
    flow.seen("odom", 1)  # late, and of no importance any more
    assert flow.in_flight() == 0


def test_a_consumer_that_comes_later_owes_nothing() -> None:
    flow = FlowControl(max_in_flight=1)
    publish(flow, 0, 1, 2)
    flow.set_topics(["odom"])
    publish(flow, 3, 4)  # one for free, one in flight
    assert not flow.may_publish()


def test_a_consumer_that_goes_holds_nobody_up() -> None:
    flow = FlowControl(max_in_flight=1)
    flow.set_topics(["odom", "ngo/pose"])
    publish(flow, 0, 1)
    flow.seen("odom", 1)
    assert not flow.may_publish()
    flow.set_topics(["odom"])
    assert flow.may_publish() and flow.topics == {"odom"}


def test_stamps_of_another_run_and_of_other_topics_are_ignored() -> None:
    flow = FlowControl(max_in_flight=1)
    flow.set_topics(["odom"])
    publish(flow, 0, 1)
    flow.seen("odom", 10**18)
    flow.seen("ngo/pose", 1)
    assert not flow.may_publish()


def test_giving_up_counts_what_is_in_flight_as_lost() -> None:
    flow = FlowControl(max_in_flight=1)
    flow.set_topics(["odom"])
    publish(flow, 0, 1)
    flow.give_up()
    assert flow.in_flight() == 0 and flow.may_publish()


def test_pace_is_kept_without_drift_and_without_bursts() -> None:
    pacer = Pacer()
    assert pacer.remaining_s(now_s=100.0) == 0.0
    pacer.taken(100.0, rate=10.0)
    assert pacer.remaining_s(100.0) == pytest.approx(0.1)
    pacer.taken(100.13, rate=10.0)  # 0.03 s late: the next is due when it always was
    assert pacer.remaining_s(100.13) == pytest.approx(0.07)
    pacer.taken(101.0, rate=10.0)  # 0.8 s late: those missed are not made up for
    assert pacer.remaining_s(101.0) == 0.0
    pacer.taken(101.0, rate=10.0)
    assert pacer.remaining_s(101.0) == pytest.approx(0.1)
