"""The convolutions of FlowNetS, whole and at a fraction of their width."""

from torch import nn

from ngo_estimator.networks.flownet import FlowNetConvolutions


def test_width_one_is_flownet_simple() -> None:
    convolutions = [m for m in FlowNetConvolutions(6, (60, 80), 1.0).layers if isinstance(m, nn.Conv2d)]
    assert [m.out_channels for m in convolutions] == [64, 128, 256, 256, 512, 512, 512, 512, 1024]
    assert [m.kernel_size[0] for m in convolutions] == [7, 5, 5, 3, 3, 3, 3, 3, 3]
    assert [m.stride[0] for m in convolutions] == [2, 2, 2, 1, 2, 1, 2, 1, 2]
