"""From a node class to a process: clean ends, and one clear line where it cannot start."""

from __future__ import annotations

import signal
import sys

import rclpy
from rclpy.logging import LoggingSeverity, get_logger_level, set_logger_level
from rclpy.signals import SignalHandlerOptions

from ngo_sim.nodes.parameters import BadParameter
from ngo_sim.nodes.simulator_node import SimulatorNode

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def run_simulator(node_type: type[SimulatorNode], name: str, args: list[str] | None = None) -> int:
    """Run a simulator node until it has published its frames or is told to end by a signal; return the exit code.

    0 in both cases, 2 after a bad parameter, which one line on stderr names.
    """
    # rclpy's own handlers shut down from another thread while this one publishes, which now and then ends in a crash,
    # and so does an exception that a handler raises within rclpy. These only say that it is to end: the node looks
    # between any two frames, and waits for short times only.
    node, ended = None, False

    def end(*_: object) -> None:
        nonlocal ended
        ended = True

    for number in _SIGNALS:
        signal.signal(number, end)
    try:
        _initialise(args)
        node = node_type(name)
        node.run(lambda: ended)
        return 0
    except BadParameter as error:
        print(f"{name}: bad parameter: {error}", file=sys.stderr)
        return 2
    except Exception:
        if not ended:
            raise
        return 0  # the engine, which a terminal tells to end as well, was sooner
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _initialise(args: list[str] | None) -> None:
    """rclpy.init, but arguments that ROS cannot read raise BadParameter, and ROS does not log them as well."""
    level = get_logger_level("rcl")
    set_logger_level("rcl", LoggingSeverity.FATAL)
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # the common base of rclpy's errors about arguments
        raise BadParameter(" ".join(str(error).split())) from None
    finally:
        set_logger_level("rcl", level)
