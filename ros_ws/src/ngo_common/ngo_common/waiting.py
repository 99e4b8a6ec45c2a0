"""Messages that wait in a subscription's queue, taken at once instead of one for each turn of the executor."""

from collections.abc import Iterator
from typing import Any


def waiting_messages(subscription: Any, most: int) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Up to ``most`` messages that have come and wait, each with its info, as the executor takes them.

    A turn of rclpy's executor costs more than many a message. Call this in a callback of the executor's thread.
    """
    for _ in range(most):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return
        yield taken
