"""Evidence of a registered step, and the factors that the trained network gives it."""

import math

import numpy as np

from ngo_estimator.geometry.planar_motion import Array, wrap
from ngo_estimator.geometry.scan_matching import Registration
from ngo_estimator.networks.step_deviation import UNSURE, StepDeviation
from ngo_estimator.odometry.motion_prior import Prediction


def step_evidence(since_key: Array, found: Registration, prediction: Prediction, searched: bool, unsure: bool) -> Array:
    """Evidence ``(12,)``, columns as in ``STEP_EVIDENCE``, of a registered scan.

    ``since_key`` ``(3,)`` is its pose seen from the last key scan.
    """
    lines = found.information
    middle, half_gap = 0.5 * (lines[0, 0] + lines[1, 1]), math.hypot(0.5 * (lines[0, 0] - lines[1, 1]), lines[0, 1])
    off = found.pose - prediction.mean
    off[2] = wrap(off[2])
    disagreement = math.sqrt(float(off @ prediction.information @ off))
    expected = 0.5 * np.log10(prediction.covariance.diagonal())
    return np.array((
        found.share,
        -0.5 * math.log10(max(middle - half_gap, 0.0) + 1.0),
        -0.5 * math.log10(middle + half_gap + 1.0),
        -0.5 * math.log10(lines[2, 2] + 1.0),
        math.hypot(since_key[0], since_key[1]),
        abs(since_key[2]),
        math.log1p(disagreement),
        float(searched),
        float(unsure),
        float(prediction.by_wheels),
        float(max(expected[0], expected[1])),
        float(expected[2]),
    ))  # fmt: skip


class StepScaling:
    """The network in numpy, for one step at a time: torch takes longer to call than to compute."""

    def __init__(self, network: StepDeviation) -> None:
        values = {name: value.detach().double().numpy() for name, value in network.state_dict().items()}
        self._middle, self._scale = network.middle.double().numpy(), network.scale.double().numpy()
        self._first, self._offset = values["layers.0.weight"], values["layers.0.bias"]
        self._head, self._bias = values["head.weight"], values["head.bias"]
        self._limit = math.log(network.config.largest)

    def factors(self, evidence: Array) -> Array:
        """Factors ``(3,)`` on the deviations of (x, y, yaw), for evidence ``(12,)``."""
        if evidence[UNSURE] > 0.0:
            return np.ones(3)
        hidden = np.tanh(self._first @ ((evidence - self._middle) / self._scale) + self._offset)
        position, heading = np.exp(self._limit * np.tanh((self._head @ hidden + self._bias) / self._limit))
        return np.array((position, position, heading))
