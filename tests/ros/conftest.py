"""Weights of an ngo_node that is fed with relative poses by the test."""

from pathlib import Path

import pytest
import torch

from .relative_poses import write_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("weights")
    write_weights(folder)
    return folder
