"""What one robot adds to the map: its scans, and the trajectory on which they lie."""

from typing import TYPE_CHECKING

import numpy as np
from ngo_msgs.msg import Trajectory

from ngo_estimator.mapping.scan_map import MapUpdate, ScanMap, ScanMapConfig
from ngo_estimator.trajectory.files import seconds

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ngo_estimator.data.relative_step import RelativeStep
    from ngo_estimator.mapping.range_scan import RangeScan


class MapLayer:
    """Takes scans and trajectories as they come, and draws them when it is asked to.

    Args:
        frame: that of the map.
        several: whether it is one of several robots: then the trajectory may be in a map of its own, and its scans wait
            until the robot is found in this one.
    """

    def __init__(self, config: ScanMapConfig, frame: str, several: bool) -> None:
        self.map = ScanMap(config, parts=several)
        self.due = False
        """Whether the map does not follow the trajectory yet."""
        self.stamp_ns = 0
        """The newest stamp of the trajectory."""
        self.missed = ""
        """What the map lacks, in words."""
        self._frame, self._several = frame, several
        self._trajectory: Trajectory | None = None
        self._begun = False

    def take(self, step: "RelativeStep", scans: "Iterable[tuple[int, RangeScan]]") -> bool:
        """Take the scans of a step; returns whether it is the first one, and others were before it."""
        self.map.take(step, scans)
        late = not self._begun and step.from_stamp_ns != step.origin_stamp_ns
        if late:
            self.missed = f"the map lacks what was seen before {seconds(step.stamp_ns)} s: this node started later"
        self._begun = True
        self.trajectory_may_know_more()
        return late

    def trajectory_may_know_more(self) -> None:
        """Draw again: the trajectory may have come before the scans."""
        self.due = self._trajectory is not None

    def follow(self, message: Trajectory) -> str:
        """Take the newest trajectory; returns why it cannot be used, or nothing."""
        lengths = {len(values) for values in (message.stamps_ns, message.x, message.y, message.yaw)}
        if message.header.frame_id != self._frame and not self._several:
            return f"it is in the frame '{message.header.frame_id}'; expected '{self._frame}'"
        if len(lengths) != 1 or 0 in lengths:
            return "its arrays are empty or of several lengths; expected one, of at least one pose"
        if not (np.diff(np.array(message.stamps_ns)) > 0).all():
            return "its stamps do not increase"
        self._trajectory, self.due = message, True
        return ""

    def draw(self, budget_s: float) -> MapUpdate:
        """Let the map follow the trajectory, if there is one; see ``ScanMap.update``."""
        if self._trajectory is None or not self.due:
            return MapUpdate(0, 0, 0, restarted=False)
        message, self.due = self._trajectory, False
        stamps_ns = np.array(message.stamps_ns)
        if message.header.frame_id != self._frame:
            withdrawn = self.map.withdraw(stamps_ns)  # it is not where it was taken to be
            return MapUpdate(0, int(withdrawn), 0, restarted=False)
        poses = np.column_stack((message.x, message.y, message.yaw))
        update = self.map.update(stamps_ns, poses, budget_s)
        self.due, self.stamp_ns = update.left > 0, int(stamps_ns[-1])
        return update
