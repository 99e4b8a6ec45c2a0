"""Takes over from the driver while somebody else sends actions. Times are passed in; no ROS."""

from __future__ import annotations

from collections import deque

from ngo_sim.drivers import Action


class ExternalActions:
    """The actions that come from outside, and when they count.

    From a command until timeout_s after it the outside is in charge. At a steady pace the newest command is held: it
    is applied to every step until a newer one comes. Without a pace (rate 0, time has no meaning) each command is
    applied to exactly one step, in order, and the simulator waits for the next one, so that whoever answers every
    image drives alone.
    """

    def __init__(self) -> None:
        self._commands: deque[Action] = deque(maxlen=1000)
        self._last_s: float | None = None

    def command(self, action: int, now_s: float) -> None:
        """Somebody sent an action; ValueError where there is no such action."""
        if action not in tuple(Action):
            raise ValueError(
                f"action is {action}; allowed: " + ", ".join(f"{int(a)} ({a.name.lower()})" for a in Action)
            )
        self._commands.append(Action(action))
        self._last_s = now_s

    def in_charge(self, now_s: float, timeout_s: float, hold: bool) -> bool:
        """Whether the last command is less than timeout_s old, or, without hold, a command still waits for its step."""
        if self._last_s is not None and now_s - self._last_s >= timeout_s and (hold or not self._commands):
            self._commands.clear()
            self._last_s = None
        return self._last_s is not None

    def pending(self) -> bool:
        """Whether a command waits for its step."""
        return bool(self._commands)

    def next_action(self, hold: bool) -> Action | None:
        """The action for the next step, None where there is none yet. hold keeps the newest, else each is used once."""
        if not self._commands:
            return None
        if not hold:
            return self._commands.popleft()
        newest = self._commands[-1]
        self._commands.clear()
        self._commands.append(newest)
        return newest
