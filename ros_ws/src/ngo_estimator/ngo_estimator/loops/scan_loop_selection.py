"""Which loops the graph of key scans uses: of those that are accepted, the ones it may believe and needs."""

import math
from collections.abc import Callable

import numpy as np

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.graph.path_covariance import path_covariances
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.sparsification import WALLS_M, largest_variances, needed_loops
from ngo_estimator.loops.scan_loops import ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig


class ScanLoopSelection:
    """Selects by row among all loops that were verified, which a caller gives as ``found``."""

    SAVED = ("_used", "doubted")

    def __init__(self, config: ScanGraphConfig) -> None:
        self._config = config
        self.doubted = np.zeros(0, np.int64)
        """Accepted loops for which too few speak as yet."""
        self._used = GrowingRows((), np.int64)

    def __len__(self) -> int:
        return len(self._used)

    @property
    def rows(self) -> np.ndarray:
        """The loops that the graph needs ``(n,)``."""
        return self._used.values

    def drop(self, which: Callable[[np.ndarray], np.ndarray]) -> int:
        """Take out for good the loops that ``which`` chooses among rows ``(n,)``; returns how many were used."""
        used = self.rows.copy()
        kept = used[~which(used)]
        self.replace(kept, self.doubted[~which(self.doubted)])
        return len(used) - len(kept)

    def replace(self, used: np.ndarray, doubted: np.ndarray) -> None:
        """Have these rows instead, as loops are numbered otherwise."""
        self._used.set(used)
        self.doubted = doubted

    def believed(self, fresh: np.ndarray, found: ScanLoops, chain: PoseGraph) -> np.ndarray:
        """Those of the newly accepted loops that the graph may use, and of others that have waited.

        A search distinguishes places within its window alone. A robot that may be farther away may be in another place
        that looks alike, which was not searched: then more loops must agree. A loop waits for as long as more may.
        """
        rows = np.concatenate((self.doubted, fresh))
        if len(rows) == 0:
            return rows
        config, windows = self._config, self._config.windows
        loops, known = found[rows], found[self.rows]
        covariance = path_covariances(
            chain.poses,
            np.concatenate((chain.edges, known.pairs)),
            np.concatenate((chain.step_covariance, known.covariance)),
            loops.pairs,
        )
        metres = windows.deviations * np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
        turn = windows.deviations * np.sqrt(covariance[:, 2, 2])
        searched = (metres <= windows.most_m) & (turn <= math.radians(windows.most_deg))
        believed = searched | (loops.agreeing >= config.agreeing_beyond)
        may_grow = loops.pairs[:, 1] >= len(chain) - 1 - config.loops.neighbour_keys
        self.doubted = rows[~believed & may_grow]
        return rows[believed]

    def use(self, rows: np.ndarray, found: ScanLoops, chain: PoseGraph) -> bool:
        """Take those of the believed loops into the graph that it needs; returns whether one surprises."""
        loops, known, config = found[rows], found[self.rows], self._config
        measured = RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance)
        off = (measured.residuals(chain.poses) ** 2).sum(1)
        at_walls = np.tile(np.diag((1.0, 1.0, WALLS_M)), (len(rows), 1, 1))
        moved = (RelativePoses(loops.pairs, loops.relative, at_walls).residuals(chain.poses) ** 2).sum(1)
        surprising = (off > config.surprise**2) & (moved > config.surprise_m**2)
        needed = needed_loops(
            np.concatenate((chain.edges, known.pairs)),
            np.concatenate((chain.step_variance, largest_variances(known.covariance))),
            loops.pairs,
            largest_variances(loops.covariance),
            surprising,
            config.redundant,
        )
        for row in rows[needed]:
            self._used.append(row)
        return bool(surprising.any())
