"""From a node class to a process: clean ends, and starts that fail with one line."""

import signal
from collections.abc import Callable

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity, get_logger, get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ngo_estimator.nodes.parameters import BadParameter

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_WAIT_S = 0.1  # for a message, before a signal that came meanwhile is seen


class StartError(Exception):
    """What keeps a node from starting; the message is one line for the user."""


def run_node(name: str, create: Callable[[], Node]) -> int:
    """Spin the node that ``create`` makes until SIGINT or SIGTERM, and return the process's exit code.

    0 after a signal, 2 where the node could not start: ROS arguments that cannot be read, a ``BadParameter``
    or a ``StartError``. One line then says why.
    """
    # rclpy's own handlers end the context from another thread while this one publishes, which now and then ends in a
    # crash, and so does an exception that a handler raises while rclpy makes a node or takes a message. These only say
    # that it is to end, which is seen once the node is made and between any two messages.
    node, ended = None, False

    def end(*_: object) -> None:
        nonlocal ended
        ended = True

    for number in _SIGNALS:
        signal.signal(number, end)
    try:
        _initialise()
        node = create()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not ended:
            executor.spin_once(timeout_sec=_WAIT_S)
        return 0
    except (BadParameter, StartError) as error:
        get_logger(name).fatal(" ".join(str(error).split()))
        return 2
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _initialise() -> None:
    level = get_logger_level("rcl")
    set_logger_level("rcl", LoggingSeverity.FATAL)  # it would say the same error on a line of its own
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # the common base of rclpy's errors about arguments
        raise StartError(str(error)) from error
    finally:
        set_logger_level("rcl", level)
