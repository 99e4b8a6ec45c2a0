"""The online trajectory of a calibrated camera: relative poses and key pictures in, the corrected trajectory out."""

from dataclasses import asdict
from typing import Any

from ngo_estimator.geometry.key_picture import LAYOUT
from ngo_estimator.loops.picture_settings import PictureGraphConfig
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.picture_back_end import PictureBackEnd
from ngo_estimator.trajectory.g2o import PlanarGraph, graph_of


class PictureTrajectory(CorrectedTrajectory):
    """Keeps the trajectory of a camera and corrects it whenever loops call for it.

    Args:
        iterations_per_step: 0: the work that a step makes due is done before its answer; else behind it.
    """

    _back_end: PictureBackEnd

    def __init__(self, config: PictureGraphConfig | None = None, iterations_per_step: int = 0) -> None:
        if iterations_per_step < 0:
            raise ValueError(f"iterations_per_step is {iterations_per_step}; expected 0 (before the answer) or more")
        self._config = config or PictureGraphConfig()
        super().__init__(answers_first=iterations_per_step > 0)

    def planar_graph(self) -> PlanarGraph | None:
        """The graph of key pictures as it is now; see ``CorrectedTrajectory.planar_graph``."""
        if self._log.steps == 0:
            return None
        back_end, graph = self._back_end, self._back_end.graph
        stamps_ns = self._log.stamps_ns.values[graph.frames.nodes]
        return graph_of(stamps_ns, graph.poses.copy(), *back_end.measurements(), back_end.belief())

    @property
    def identity(self) -> dict[str, Any]:
        """The settings, and the layout of key pictures: there are no networks."""
        return {"key_picture_layout": LAYOUT, "camera": asdict(self._config)}

    def _new_back_end(self) -> PictureBackEnd:
        return PictureBackEnd(self._config)
