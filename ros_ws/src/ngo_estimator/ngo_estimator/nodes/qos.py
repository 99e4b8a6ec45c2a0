"""Quality of service that a user may override for each topic, the way that ROS 2 has for it."""

from rclpy.qos import QoSPolicyKind
from rclpy.qos_overriding_options import QoSOverridingOptions

_POLICIES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)


def overridable() -> QoSOverridingOptions:
    """Parameters ``qos_overrides.TOPIC.publisher.depth`` and the like for one end of a topic."""
    return QoSOverridingOptions(policy_kinds=_POLICIES)
