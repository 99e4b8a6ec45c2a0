"""One step of a lidar's odometry."""

from dataclasses import dataclass

from ngo_estimator.data.relative_step import RelativeStep


@dataclass(frozen=True, eq=False)
class LidarStep(RelativeStep):
    """Motion between two scans.

    ``share`` is how well the newer scan fits what was seen before, 0 to 1. The scan of an ``unsure`` step does not say
    where it was taken.
    """

    share: float
    unsure: bool
