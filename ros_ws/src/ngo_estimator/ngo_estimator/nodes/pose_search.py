"""The search for a robot in a saved map, which stays as it is or grows on once the robot is found."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ngo_estimator.data.relative_step import RelativeStep
    from ngo_estimator.slam.joining import Joining
    from ngo_estimator.slam.map_localisation import LocalisedStep, MapLocalisation


class PoseSearch:
    """Takes steps, keeps what the newest one gave, and says it in diagnostics."""

    def __init__(self, search: "MapLocalisation | Joining") -> None:
        self._search = search
        self._newest: LocalisedStep | None = None

    def update(self, step: "RelativeStep") -> "LocalisedStep":
        """What is known after a step; raises ``RejectedStep`` for one that cannot be used."""
        self._newest = self._search.update(step)
        return self._newest

    def reset(self) -> None:
        """Forget the pose."""
        self._search.reset()
        self._newest = None

    def set_pose(self, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> None:
        """Take the pose ``(3,)`` in ``map``, and its covariance ``(3, 3)``, from somebody who knows them."""
        self._search.set_pose(pose_xyyaw, covariance)

    def details(self) -> dict[str, str]:
        """Values for diagnostics."""
        return {"localisation": "localised" if self._known else "not localised", "hypotheses": self._hypotheses()}

    def problems(self) -> list[str]:
        """That the pose is not known, with where the robot may be; nothing where it is known."""
        return [] if self._known else [f"not localised: {self._hypotheses() or 'no hypothesis yet'}"]

    @property
    def _known(self) -> bool:
        return self._newest is not None and self._newest.found.pose_xyyaw is not None

    def _hypotheses(self) -> str:
        """Where the robot may be, the best supported first."""
        modes = () if self._newest is None else self._newest.found.hypotheses
        poses = [(*mode.pose_xyyaw.tolist(), mode.support) for mode in modes]
        return "; ".join(f"x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad, support {n:.1f}" for x, y, yaw, n in poses)
