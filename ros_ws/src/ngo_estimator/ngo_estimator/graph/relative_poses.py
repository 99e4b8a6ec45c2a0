"""Measured poses of nodes seen from others: the edges of a pose graph, each with a whole information matrix."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ngo_estimator.graph.loop_errors import predicted_covariances, whitened_residuals

BELIEVED = 0.5
"""Weight of an edge, zero to one, from which on it is believed."""


@dataclass(frozen=True)
class RelativePoses:
    """Measured poses of nodes, each seen from another.

    ``nodes`` ``(n, 2)``: the second is seen from the first; ``relative`` ``(n, 3)`` (m, m, rad). ``root`` ``(n, 3, 3)``
    makes the information matrix ``root.T @ root``, along the axes of the first node. A row of zeros is a direction of
    which nothing is known: where nobody saw the heading, the last row is zero.
    """

    nodes: np.ndarray
    relative: np.ndarray
    root: np.ndarray

    @classmethod
    def of_covariances(cls, nodes: np.ndarray, relative: np.ndarray, covariance: np.ndarray) -> "RelativePoses":
        """Measurements with covariances ``(n, 3, 3)``; raises ``ValueError`` for one that is not positive definite."""
        try:
            lower = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            raise ValueError("a covariance is not positive definite; expected positive definite ones") from None
        return cls(nodes, relative, np.linalg.inv(lower))

    @classmethod
    def of_deviations(cls, nodes: np.ndarray, relative: np.ndarray, deviations: np.ndarray) -> "RelativePoses":
        """Measurements with independent errors of these deviations ``(n, 3)``; infinite where nothing is known.

        A loop that only says "the same place" has the relative pose 0, a wide deviation in x and y, and an infinite one
        in the heading. Raises ``ValueError`` for a deviation that is not positive.
        """
        if not (deviations > 0.0).all():
            raise ValueError("a deviation is not positive; expected positive ones, infinite where nothing is known")
        return cls(nodes, relative, np.eye(3) / deviations[:, None, :])

    def __len__(self) -> int:
        return len(self.nodes)

    def __getitem__(self, rows: np.ndarray | slice) -> "RelativePoses":
        """Some of these measurements."""
        return RelativePoses(self.nodes[rows], self.relative[rows], self.root[rows])

    def extended(self, others: "RelativePoses") -> "RelativePoses":
        """These measurements, then the others."""
        columns = ((self.nodes, others.nodes), (self.relative, others.relative), (self.root, others.root))
        return RelativePoses(*map(np.concatenate, columns))

    def scaled(self, variance: float) -> "RelativePoses":
        """The same with covariances so many times as large."""
        return RelativePoses(self.nodes, self.relative, self.root / np.sqrt(variance))

    @cached_property
    def information(self) -> np.ndarray:
        """Information matrices ``(n, 3, 3)``, along the axes of the first node."""
        information: np.ndarray = self.root.mT @ self.root
        return information

    @property
    def degrees(self) -> np.ndarray:
        """How many directions each measurement knows ``(n,)``, 0 to 3."""
        known: np.ndarray = (self.root != 0.0).any(2).sum(1)
        return known

    def residuals(self, poses: np.ndarray) -> np.ndarray:
        """Whitened residuals ``(n, 3)``, measured less predicted, under poses ``(nodes, 3)``."""
        whitened: np.ndarray = whitened_residuals(*self._arrays, np.ascontiguousarray(poses, np.float64))
        return whitened

    def squared(self, poses: np.ndarray) -> np.ndarray:
        """Squared lengths ``(n,)`` of the whitened residuals."""
        residuals = self.residuals(poses)
        squared: np.ndarray = np.einsum("ki,ki->k", residuals, residuals)
        return squared

    def predicted_covariances(self, poses: np.ndarray, joint: np.ndarray) -> np.ndarray:
        """Covariances ``(n, 3, 3)`` of the whitened predictions, from those ``(n, 6, 6)`` of both nodes' poses."""
        predicted: np.ndarray = predicted_covariances(self._arrays[0], self._arrays[2], poses, joint)
        return predicted

    @cached_property
    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes, relative poses and roots as compiled code takes them."""
        return (
            np.ascontiguousarray(self.nodes, np.int64),
            np.ascontiguousarray(self.relative, np.float64),
            np.ascontiguousarray(self.root, np.float64),
        )

    def whitened_jacobian(self, poses: np.ndarray) -> np.ndarray:
        """Derivative ``(n, 3, 6)`` of the whitened prediction by the poses of both nodes."""
        start, end = (poses[self.nodes[:, k]] for k in (0, 1))
        cos, sin = np.cos(start[:, 2]), np.sin(start[:, 2])
        x, y = end[:, 0] - start[:, 0], end[:, 1] - start[:, 1]
        jacobian = np.zeros((len(self.nodes), 3, 6))
        jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = -cos, -sin, cos * y - sin * x
        jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = sin, -cos, -cos * x - sin * y
        jacobian[:, 2, 2], jacobian[:, 2, 5] = -1.0, 1.0
        jacobian[:, 0, 3], jacobian[:, 0, 4], jacobian[:, 1, 3], jacobian[:, 1, 4] = cos, sin, -sin, cos
        whitened: np.ndarray = self.root @ jacobian
        return whitened
