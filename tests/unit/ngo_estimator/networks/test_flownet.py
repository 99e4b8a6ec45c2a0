"""The convolutions of FlowNetS, whole and at a fraction of their width."""

import pytest
import torch
from torch import nn

from ngo_estimator.networks.flownet import FlowNetConvolutions


def test_width_one_is_flownet_simple() -> None:
    convolutions = [m for m in FlowNetConvolutions(6, (60, 80), 1.0).layers if isinstance(m, nn.Conv2d)]
    assert [m.out_channels for m in convolutions] == [64, 128, 256, 256, 512, 512, 512, 512, 1024]
    assert [m.kernel_size[0] for m in convolutions] == [7, 5, 5, 3, 3, 3, 3, 3, 3]
    assert [m.stride[0] for m in convolutions] == [2, 2, 2, 1, 2, 1, 2, 1, 2]


@pytest.mark.parametrize("size", [(60, 80), (1, 241), (61, 83), (1, 8), (8, 8)])
def test_output_size_is_what_comes_out(size: tuple[int, int]) -> None:
    network = FlowNetConvolutions(3, size, 0.05)
    assert network(torch.zeros(2, 3, *size)).shape == (2, network.output_size)


def test_a_row_scan_gets_one_dimensional_convolutions() -> None:
    assert all(isinstance(m, (nn.Conv1d, nn.LeakyReLU)) for m in FlowNetConvolutions(4, (1, 241), 0.1).layers)
