"""A managed node that may start itself: what its transitions make is undone, and a failure is said in one line."""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import ExitStack

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNode):
    """Undoes in ``cleanup`` what ``_built`` holds, and in ``deactivate`` what ``_listening`` holds."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._built, self._listening = ExitStack(), ExitStack()
        self._failure: Exception | None = None
        self._starting = False

    @abstractmethod
    def _configure(self) -> None:
        """Make all that the node has while it is configured."""

    @abstractmethod
    def _listen(self) -> None:
        """Begin to take messages."""

    def _start(self) -> None:
        """Configure and activate; raises the error that keeps the node from starting."""
        self._starting = True
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != _SUCCESS and self._failure is not None:
                raise self._failure
        self._starting = False

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make topics and services."""
        return self._attempt(self._configure, self._built)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to take messages."""
        super().on_activate(state)
        return self._attempt(self._listen, self._listening)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop taking messages."""
        self._listening.close()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop all that was configured."""
        self._built.close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End everything."""
        self._listening.close()
        self._built.close()
        return super().on_shutdown(state)

    def _attempt(self, work: Callable[[], None], undo: ExitStack) -> TransitionCallbackReturn:
        """Do the work of a transition; one that fails is undone, and its reason said in one line."""
        try:
            work()
        except Exception as error:  # rclpy itself would say nothing about it
            undo.close()
            self._failure = error
            if not self._starting:  # the caller of _start() reports it
                self.get_logger().error(" ".join(str(error).split()) or repr(error))
            return _FAILURE
        return _SUCCESS

    def destroy_node(self) -> None:
        """End the node: rclpy leaves its state machine, whose services would keep it in the graph."""
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()
