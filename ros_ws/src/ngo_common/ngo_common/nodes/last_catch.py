"""The last catch: an error that nothing else caught becomes one line in the log. It never ends a node."""

import traceback
from collections.abc import Callable, Iterable
from typing import Any

from rclpy.executors import Executor, await_or_execute
from rclpy.node import Node
from rclpy.service import Service

_QUIET_S = 5.0


def spin_once(node: Node, executor: Executor, timeout_s: float) -> None:
    """Call the callbacks that are due, after at most ``timeout_s``; report an error of one, and go on."""
    try:
        executor.spin_once(timeout_sec=timeout_s)
    except Exception as error:
        if not node.context.ok():  # nothing can go on
            raise
        line = f"internal error, {_line(error)}"
        node.get_logger().error(line, throttle_duration_sec=_QUIET_S)
        node.get_logger().debug(traceback.format_exc())


def answer_always(node: Node, services: Iterable[Service]) -> None:
    """Let each service answer with its empty response, ``success`` false, where its callback raises an error."""
    for service in services:
        service.callback = _answering(node, service, service.callback)


def _answering(node: Node, service: Service, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    async def answer(request: Any, response: Any) -> Any:
        try:
            return await await_or_execute(callback, request, response)
        except Exception as error:
            node.get_logger().warning(f"service {service.srv_name}: {_line(error)}")
            node.get_logger().debug(traceback.format_exc())
            return type(response)()

    return answer


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
