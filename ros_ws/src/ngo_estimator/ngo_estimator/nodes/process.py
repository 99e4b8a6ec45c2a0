"""From a node class to a process: clean ends, and starts that fail with one line."""

import signal
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import LoggingSeverity, get_logger, get_logger_level, set_logger_level
from rclpy.node import Node

from ngo_estimator.nodes.parameters import BadParameter


class StartError(Exception):
    """What keeps a node from starting; the message is one line for the user."""


def run_node(name: str, create: Callable[[], Node]) -> int:
    """Spin the node that ``create`` makes until SIGINT or SIGTERM, and return the process's exit code.

    0 after a signal, 2 where the node could not start: ROS arguments that cannot be read, a ``BadParameter``
    or a ``StartError``. One line then says why.
    """
    node = None
    try:
        _initialise()
        node = create()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (BadParameter, StartError) as error:
        get_logger(name).fatal(" ".join(str(error).split()))
        return 2
    except rclpy_implementation.RCLError:
        # A signal ends the context while a callback runs: what the callback then publishes fails, as it
        # should.
        if rclpy.ok():
            raise
    finally:
        # A second signal, as from a terminal and a launcher together, must not interrupt the cleaning up.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _initialise() -> None:
    level = get_logger_level("rcl")
    set_logger_level("rcl", LoggingSeverity.FATAL)  # it would say the same error on a line of its own
    try:
        rclpy.init()
    except RuntimeError as error:  # the common base of rclpy's errors about arguments
        raise StartError(str(error)) from error
    finally:
        set_logger_level("rcl", level)
