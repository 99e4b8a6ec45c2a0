"""Compiled motions are those of ``se2``."""

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import frames_between_nodes
from ngo_estimator.ngo.pose_aggregation import in_block_poses

BLOCK = 8


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(("blocks", "behind"), [(0, 5), (1, 0), (1, 7), (40, 3)])
def test_frames_follow_corrected_nodes_as_in_the_optimizer(blocks: int, behind: int, joined: bool) -> None:
    rng = np.random.default_rng(20000)
    odometry = rng.normal(0.0, 3.0, (blocks * BLOCK + 1 + behind, 3))
    nodes = rng.normal(0.0, 3.0, (blocks + 1, 3))
    shares, joins = np.tile(np.arange(1, BLOCK + 1) / BLOCK, (blocks, 1)), np.zeros(0, np.int64)
    if joined and blocks:  # the third frame of the last block: the motion that nobody saw is the one that is corrected
        shares[-1], joins = np.arange(1, BLOCK + 1) >= 3, np.array([(blocks - 1) * BLOCK + 3])

    steps, corrected = torch.from_numpy(odometry), torch.from_numpy(nodes)
    starts, whole = steps[: blocks * BLOCK + 1 : BLOCK].unsqueeze(1), blocks * BLOCK
    in_blocks = se2.between(starts[:-1], steps[1 : whole + 1].reshape(blocks, BLOCK, 3)).unsqueeze(0)
    relative = se2.between(corrected[:-1], corrected[1:]).unsqueeze(0)
    if joins.size:
        bent = in_blocks + torch.from_numpy(shares)[..., None] * se2.wrapped(relative - in_blocks[:, :, -1])[:, :, None]
    else:
        bent = in_block_poses(in_blocks, relative)
    expected = torch.cat(
        (
            corrected[:1],
            se2.compose(corrected[:-1].unsqueeze(1), bent[0]).reshape(-1, 3),
            se2.compose(corrected[-1:], se2.between(starts[-1], steps[whole + 1 :])),
        )
    )
    np.testing.assert_allclose(
        frames_between_nodes(nodes, odometry, BLOCK * np.arange(blocks + 1), joins), expected, atol=1e-13
    )
