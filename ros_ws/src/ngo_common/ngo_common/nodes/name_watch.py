"""Whether another node has the name of this one: ROS allows it, and services and parameters then reach either."""

from rclpy.node import Node


class NameWatch:
    """Looks for a second node of the same name, and warns once when it comes."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._warned = False

    def look(self) -> str:
        """Look for it now: a line about the other node, empty where there is none."""
        own = (self._node.get_name(), self._node.get_namespace())
        if self._node.get_node_names_and_namespaces().count(own) < 2:
            self._warned = False
            return ""
        name = self._node.get_fully_qualified_name()
        line = f"two nodes are named {name}, or one was killed just now: give each a name or a namespace of its own"
        if not self._warned:
            self._warned = True
            self._node.get_logger().warning(line)
        return line
