"""Weights of an ngo_node that is fed with relative poses by the test, and what nodes of a lidar need to start fast."""

from pathlib import Path

import pytest
import torch

from ngo_estimator.mapping import scan_map
from ngo_estimator.offline import warm_up_scans, warm_up_trajectory
from ngo_estimator.slam.online_trajectory import OnlineTrajectory

from .relative_poses import WORLD, write_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("weights")
    write_weights(folder)
    return folder


@pytest.fixture(scope="session", autouse=True)
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Estimators and maps, compiled: in a fresh clone a node takes longer to start than tests wait for it."""
    warm_up_scans.warm_up_scans()
    scan_map.warm_up()
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("compiled")
    write_weights(folder)
    warm_up_trajectory.warm_up_networks(OnlineTrajectory.load(folder, 32, WORLD))
