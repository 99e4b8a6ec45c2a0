from ngo_sim.drivers import Action
from ngo_sim.external_actions import ExternalActions

TIMEOUT_S = 0.5


def test_is_not_in_charge_before_the_first_command_nor_after_the_timeout() -> None:
    external = ExternalActions()
    assert not external.in_charge(0.0, TIMEOUT_S, hold=True)
    external.command(Action.TURN_LEFT, 1.0)
    assert external.in_charge(1.49, TIMEOUT_S, hold=True)
    assert not external.in_charge(1.5, TIMEOUT_S, hold=True)
    assert external.next_action(hold=True) is None


def test_holds_the_newest_command_at_a_pace() -> None:
    external = ExternalActions()
    external.command(0, 0.0)
    external.command(2, 0.0)
    assert [external.next_action(hold=True) for _ in range(3)] == [Action.TURN_RIGHT] * 3
    external.command(1, 0.1)
    assert external.next_action(hold=True) is Action.TURN_LEFT


def test_uses_each_command_once_without_a_pace() -> None:
    external = ExternalActions()
    for action in (0, 1, 2):
        external.command(action, 0.0)
    taken = [external.next_action(hold=False) for _ in range(4)]
    assert taken == [Action.FORWARD, Action.TURN_LEFT, Action.TURN_RIGHT, None]
    assert external.in_charge(0.1, TIMEOUT_S, hold=False)  # waits for the next one
    assert not external.pending()


def test_without_a_pace_no_command_is_forgotten_while_others_are_slow() -> None:
    external = ExternalActions()
    external.command(1, 0.0)
    assert external.in_charge(100.0, TIMEOUT_S, hold=False)
    assert external.next_action(hold=False) is Action.TURN_LEFT
    assert not external.in_charge(100.0, TIMEOUT_S, hold=False)
