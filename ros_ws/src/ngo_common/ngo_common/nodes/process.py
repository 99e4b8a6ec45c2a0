"""From a node class to a process: signals, exit codes, ``--help``, and one line where a start fails."""

import gc
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import rclpy
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity, get_logger, get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ngo_common.nodes.last_catch import answer_always, spin_once
from ngo_common.settings import BadParameter

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_WAIT_S = 0.1  # for a message, before the next look for a signal
_FAST_DDS = {
    "kilted": ("FASTDDS_DEFAULT_PROFILES_FILE", "fast_dds_3.xml"),
    "jazzy": ("FASTRTPS_DEFAULT_PROFILES_FILE", "fast_dds.xml"),
}
"""Fast DDS's name for a file of settings, and ours: each ROS 2 has its own version, which refuses the other's words."""

NodeType = TypeVar("NodeType", bound=Node)


class StartError(Exception):
    """A node cannot start; the message is one line for the user."""


class RunError(Exception):
    """A running node cannot go on; the message is one line for the user."""


def spin(node: Node, ended: Callable[[], bool]) -> None:
    """Call the node's callbacks until ``ended()``; an error in one is reported, and does not end the node."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended():
        spin_once(node, executor, _WAIT_S)


def run_node(
    name: str,
    create: Callable[[], NodeType],
    usage: str,
    run: Callable[[NodeType, Callable[[], bool]], None] = spin,
    args: list[str] | None = None,
) -> int:
    """Make a node, run it until SIGINT or SIGTERM or until ``run`` returns, and return the process's exit code.

    The code is 0 after a signal and at the end of ``run``. It is 2 where the node could not start (arguments that
    cannot be read, a ``BadParameter``, a ``StartError``) and 1 where it could not go on (a ``RunError``), with one line
    that says why. ``--help`` prints ``usage`` instead of starting the node.

    args: the command line, ``sys.argv`` by default.
    """
    # rclpy's own handlers end the context from another thread while this one publishes, which now and then ends in a
    # crash, and so does an exception that a handler raises while rclpy makes a node or takes a message. These handlers
    # only leave a note. It is read once the node is made, and between turns of a few messages.
    node, signalled = None, False

    def note(*_: object) -> None:
        nonlocal signalled
        signalled = True

    for number in _SIGNALS:
        signal.signal(number, note)
    try:
        if _asks_for_help(args):
            print(usage)
            return 0
        # A file that the user names stays. Other middleware does not know the name.
        variable, file = _FAST_DDS.get(os.environ.get("ROS_DISTRO", ""), _FAST_DDS["jazzy"])
        os.environ.setdefault(variable, str(Path(__file__).with_name(file)))
        with _argument_errors():
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = create()
            answer_always(node, node.services)
            gc.freeze()  # what a start leaves behind: hundreds of thousands of objects that stay
            run(node, lambda: signalled)
        finally:
            if node is not None:
                node.destroy_node()
        return 0
    except (BadParameter, StartError, InvalidParameterTypeException) as error:
        get_logger(name).fatal(" ".join(str(error).split()))
        return 2
    except Exception as error:
        if signalled:
            return 0  # a child process, which a terminal signals as well, ended sooner
        if not isinstance(error, RunError):
            raise
        get_logger(name).fatal(" ".join(str(error).split()))
        return 1
    finally:
        rclpy.try_shutdown()


def _asks_for_help(args: list[str] | None) -> bool:
    with _argument_errors():
        arguments = remove_ros_args(args)[1:]
    if "-h" in arguments or "--help" in arguments:
        return True
    if arguments:
        raise StartError(f"argument '{arguments[0]}' is unknown; parameters are given as --ros-args -p NAME:=VALUE")
    return False


@contextmanager
def _argument_errors() -> Iterator[None]:
    """Raise ``StartError`` for arguments that rclpy cannot read; rcl would say the same on a line of its own."""
    level = get_logger_level("rcl")
    set_logger_level("rcl", LoggingSeverity.FATAL)
    try:
        yield
    except RuntimeError as error:  # the common base of rclpy's errors about arguments
        raise StartError(str(error)) from error
    finally:
        set_logger_level("rcl", level)
