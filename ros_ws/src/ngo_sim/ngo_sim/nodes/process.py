"""From a node class to a process: clean ends, and one clear line where it cannot start."""

from __future__ import annotations

import signal
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.logging import LoggingSeverity, get_logger_level, set_logger_level

from ngo_sim.nodes.parameters import BadParameter
from ngo_sim.nodes.simulator_node import SimulatorNode


def run_simulator(node_type: type[SimulatorNode], name: str, args: list[str] | None = None) -> int:
    """Run a simulator node until it has published its frames or is told to end by a signal; return the exit code.

    0 in both cases, 2 after a bad parameter, which one line on stderr names.
    """
    node = None
    try:
        _initialise(args)
        node = node_type(name)
        node.run()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except BadParameter as error:
        print(f"{name}: bad parameter: {error}", file=sys.stderr)
        return 2
    except Exception:
        # A signal invalidates everything of ROS at once, and also ends the engine of the 3D world: what was going on
        # then fails for that reason alone.
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


def _initialise(args: list[str] | None) -> None:
    """rclpy.init, but arguments that ROS cannot read raise BadParameter, and ROS does not log them as well."""
    level = get_logger_level("rcl")
    set_logger_level("rcl", LoggingSeverity.FATAL)
    try:
        rclpy.init(args=args)
    except RuntimeError as error:  # the common base of rclpy's errors about arguments
        raise BadParameter(" ".join(str(error).split())) from None
    finally:
        set_logger_level("rcl", level)
