"""How far to trust a registered step, in numpy: the network of ``step_deviation`` for one step at a time.

Torch takes longer to call than to compute, and seconds and 200 MB to import.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ngo_estimator.data.weights_file import CheckpointError, read_weights
from ngo_estimator.geometry.planar_motion import Array

STEP_DEVIATION = "step_deviation"
STEP_EVIDENCE = (
    "share", "weakest", "strongest", "heading", "distance", "turn", "disagreement", "searched", "unsure", "wheels",
    "expected_m", "expected_rad",
)  # fmt: skip
"""Columns of a step's evidence.

The share of points on lines; common logarithms of the deviations that the lines alone leave (m, in their weakest and
strongest direction; rad); the motion since the last key scan (m, rad); the distance from the prediction in deviations,
as log(1 + d); whether a search was needed, the scan was of no use, and wheels made the prediction; common logarithms
of the prediction's deviations (m, rad).
"""


UNSURE = STEP_EVIDENCE.index("unsure")

MIDDLE = (0.95, -2.1, -2.35, -2.75, 0.3, 0.05, 0.3, 0.2, 0.0, 0.9, -1.2, -1.3)
SCALE = (0.06, 0.3, 0.12, 0.25, 0.1, 0.12, 0.25, 0.3, 0.3, 0.3, 0.12, 0.15)


@dataclass(frozen=True)
class StepDeviationConfig:
    """Shape of the network: ``hidden`` units; factors lie within ``largest`` and its inverse.

    In use they are at least ``least``. Errors of usual scanners grow more slowly than those of independent steps, and
    the network learned that. Scanners with a narrow view turn their map with each key scan: their errors do not.
    """

    hidden: int = 16
    largest: float = 20.0
    least: float = 0.6

    def __post_init__(self) -> None:
        if self.hidden < 1 or not (0.0 < self.least <= 1.0 < self.largest < math.inf):
            raise ValueError(
                f"hidden, least, largest are {self.hidden}, {self.least}, {self.largest}; expected at least 1, over 0 "
                "to 1, and over 1"
            )


class StepScaling:
    """Factors on the deviations of one step.

    Args:
        config: shape of the network.
        arrays: its weights by their names in ``StepDeviation``.

    Raises:
        ValueError: weights are missing, or do not fit the shape.
    """

    def __init__(self, config: StepDeviationConfig, arrays: dict[str, np.ndarray]) -> None:
        shapes = {
            "layers.0.weight": (config.hidden, len(STEP_EVIDENCE)),
            "layers.0.bias": (config.hidden,),
            "head.weight": (2, config.hidden),
            "head.bias": (2,),
        }
        given = {name: array.shape for name, array in arrays.items()}
        if given != shapes:
            raise ValueError(f"the weights are {given}; expected {shapes}")
        self._first, self._offset, self._head, self._bias = (arrays[name].astype(np.float64) for name in shapes)
        self._limit, self._least = math.log(config.largest), config.least

    @classmethod
    def load(cls, weights: Path, world: str | None = None) -> "StepScaling":
        """The network in the folder ``weights``.

        Raises:
            CheckpointError: of one clear line.
        """
        path = weights / f"{STEP_DEVIATION}.safetensors"
        config, arrays, _ = read_weights(path, STEP_DEVIATION, StepDeviationConfig, world)
        try:
            return cls(config, arrays)
        except ValueError as error:
            raise CheckpointError(f"{path}: does not fit its configuration ({error})") from error

    def factors(self, evidence: Array) -> Array:
        """Factors ``(3,)`` on the deviations of (x, y, yaw), for evidence ``(12,)``."""
        if evidence[UNSURE] > 0.0:
            return np.ones(3)
        hidden = np.tanh(self._first @ ((evidence - MIDDLE) / SCALE) + self._offset)
        found = np.exp(self._limit * np.tanh((self._head @ hidden + self._bias) / self._limit))
        position, heading = np.maximum(found, self._least)
        return np.array((position, position, heading))
