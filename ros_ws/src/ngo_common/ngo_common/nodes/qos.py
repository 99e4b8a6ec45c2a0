"""Quality of service that a user may override for each topic, with ROS 2's own parameters for it."""

from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.exceptions import ParameterException
from rclpy.qos import QoSPolicyKind
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions

from ngo_common.settings import BadParameter

_POLICIES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)


def overridable() -> QoSOverridingOptions:
    """Parameters ``qos_overrides.TOPIC.publisher.depth`` and the like for one end of a topic."""
    return QoSOverridingOptions(policy_kinds=_POLICIES)


@contextmanager
def checked_overrides() -> Iterator[None]:
    """Around the creation of topics: raises ``BadParameter`` for an override that rclpy refuses."""
    try:
        yield
    except (InvalidQosOverridesError, ParameterException, RuntimeError, ValueError) as error:
        raise BadParameter(f"parameters qos_overrides: {' '.join(str(error).split())}") from error
