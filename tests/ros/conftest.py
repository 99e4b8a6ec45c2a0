"""Weights of an ngo_node that is fed with relative poses by the test, and what nodes of a lidar need to start fast."""

from pathlib import Path

import pytest
import torch

from ngo_estimator.mapping import scan_map
from ngo_estimator.offline import warm_up

from .relative_poses import write_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("weights")
    write_weights(folder)
    return folder


@pytest.fixture(scope="session")
def compiled() -> None:
    """A lidar's estimators and maps, compiled: in a fresh clone a node takes longer to start than tests wait for it."""
    warm_up.warm_up()
    scan_map.warm_up()
