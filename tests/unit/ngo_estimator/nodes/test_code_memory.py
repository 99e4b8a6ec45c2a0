"""What libraries needed to start is given back, and what is called again goes on."""

from pathlib import Path

import numpy as np
import torch
from numba import njit

from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.nodes.code_memory import release_code


def code_kb() -> int:
    """Resident memory of the code of numba's compiler and of torch."""
    resident, counts = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if "-" in line.split()[0]:
            counts = ("libllvmlite" in line or "libtorch_" in line) and " r-xp " in line
        elif counts and line.startswith("Rss:"):
            resident += int(line.split()[1])
    return resident


def test_code_leaves_memory_and_comes_back_where_it_is_called() -> None:
    pose, step = np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.0, 0.1])
    before = compose(pose, step)
    assert code_kb() > 10_000
    release_code()
    assert code_kb() < 1_000
    np.testing.assert_array_equal(compose(pose, step), before)
    assert njit(lambda a: a + 1)(1) == 2
    assert torch.linspace(0.0, 1.0, 3).sum() == 1.5
