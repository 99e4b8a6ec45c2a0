"""How much a computation computes and moves, and what the machine could do in that time at most."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from ngo_estimator.graph import block_cholesky

_SIDE = 1024
_COPY_BYTES = 2**26
_REPEATS = 7


@dataclass(frozen=True)
class Peak:
    """What one core of this machine does: float32 products in Gflop/s, and bytes read and written in GB/s."""

    gflops: float
    gbytes: float


@dataclass
class Work:
    """Floating-point operations by kind, and bytes read and written (whether or not they come from a cache)."""

    products: float = 0.0
    elementwise: float = 0.0
    sparse: float = 0.0
    bytes: float = 0.0

    @property
    def flops(self) -> float:
        """Of all kinds."""
        return self.products + self.elementwise + self.sparse

    def bound_ms(self, peak: Peak) -> float:
        """The least time it can take: the longer one of computing and moving."""
        return max(1e-6 * self.flops / peak.gflops, 1e-6 * self.bytes / peak.gbytes)


def measured_peak() -> Peak:
    """Of the best of some repetitions each, on one thread."""
    torch.set_num_threads(1)
    a, b = torch.rand(_SIDE, _SIDE), torch.rand(_SIDE, _SIDE)
    out = torch.empty(_SIDE, _SIDE)
    source = np.ones(_COPY_BYTES // 8)
    target = np.zeros_like(source)
    return Peak(
        gflops=2e-9 * _SIDE**3 / _fastest(lambda: torch.mm(a, b, out=out)),
        gbytes=2e-9 * _COPY_BYTES / _fastest(lambda: np.copyto(target, source)),
    )


@contextlib.contextmanager
def counted(work: Work | None = None) -> Iterator[Work]:
    """Count what torch and the sparse factorisation do meanwhile; what else is compiled is small beside it.

    It is added to ``work``, where that is given.
    """
    work = Work() if work is None else work
    factorise, solve = block_cholesky.factorise, block_cholesky.solve

    def factorised(starts: Any, rows: Any, *blocks: Any) -> Any:
        work.sparse += _factorisation_flops(np.diff(starts))
        work.bytes += 2 * sum(array.nbytes for array in blocks)
        return factorise(starts, rows, *blocks)

    def solved(starts: Any, rows: Any, diagonal: Any, lower: Any, right: Any) -> None:
        # A product and a sum an entry, forward and back.
        work.sparse += 4.0 * (diagonal.size + lower.size) * right.shape[2]
        work.bytes += 2 * (diagonal.nbytes + lower.nbytes)
        solve(starts, rows, diagonal, lower, right)

    flops = FlopCounterMode(display=False)
    patched = mock.patch.multiple(block_cholesky, factorise=factorised, solve=solved)
    with patched, _Traffic(work), flops:
        yield work
    work.products += flops.get_total_flops()


class _Traffic(TorchDispatchMode):
    """Sums the sizes of the tensors that each operation reads and writes; views move nothing."""

    def __init__(self, work: Work) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._work = work

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        read = [leaf for leaf in tree_leaves((args, kwargs or {})) if isinstance(leaf, torch.Tensor)]
        written = [leaf for leaf in tree_leaves(result) if isinstance(leaf, torch.Tensor)]
        storages = {tensor.untyped_storage().data_ptr() for tensor in read}
        views = all(tensor.untyped_storage().data_ptr() in storages for tensor in written)
        if not views or func._schema.is_mutable:
            self._work.bytes += sum(tensor.nbytes for tensor in (*read, *written))
            if torch.Tag.pointwise in func.tags:
                self._work.elementwise += sum(tensor.numel() for tensor in written if tensor.is_floating_point())
        return result


def _factorisation_flops(heights: np.ndarray) -> float:
    """Of eliminating columns of so many blocks: a division an entry below, a product and a sum for half the pairs."""
    below = (3.0 * heights[:, None] + np.array([2.0, 1.0, 0.0])).ravel()
    return float((below + below * (below + 1.0)).sum())


def _fastest(action: Any) -> float:
    """Seconds by the clock."""
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        action()
        times.append(time.perf_counter() - begin)
    return min(times)
