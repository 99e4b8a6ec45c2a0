"""Image formats: what is refused, and what the networks see."""

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import WORLD_IMAGES
from ngo_estimator.data.images import ImageFormat, reduced, to_network
from ngo_estimator.data.observations import observation


def test_check_names_what_is_wrong() -> None:
    image = WORLD_IMAGES["maze2d"]
    good = np.ones((1, 241, 4), np.float32)
    image.check(good)
    with pytest.raises(ValueError, match=r"\(241, 4\)"):
        image.check(good[0])
    with pytest.raises(ValueError, match="float64"):
        image.check(good.astype(np.float64))
    bad = good.copy()
    bad[0, 3, 1] = np.nan
    with pytest.raises(ValueError, match="1 values that are not finite"):
        image.check(bad)
    bad = good.copy()
    bad[0, :2, 3] = -0.3  # where the network's input would be infinite
    with pytest.raises(ValueError, match="2 negative depths"):
        image.check(bad)
    for colour in (-0.1, 1.1, 1e38):
        bad = good.copy()
        bad[0, 7, 2] = colour
        with pytest.raises(ValueError, match="1 colours out of range"):
            image.check(bad)


def test_network_input_is_channels_first_and_near_zero() -> None:
    colour = to_network(
        torch.tensor([0, 255], dtype=torch.uint8).reshape(1, 1, 2, 1).expand(1, 1, 2, 3), ImageFormat(1, 9, 3, "uint8")
    )
    assert colour.shape == (1, 3, 1, 2) and colour.dtype == torch.float32
    assert colour[0, :, 0, 0].tolist() == [-0.5] * 3 and colour[0, :, 0, 1].tolist() == [0.5] * 3
    scan = torch.tensor([[[1.0, 0.0, 0.5, 0.3]]])  # one pixel: red 1, green 0, blue a half, 0.3 m
    assert torch.allclose(to_network(scan, WORLD_IMAGES["maze2d"]).flatten(), torch.tensor([0.5, -0.5, 0.0, 0.5]))


def test_grey_and_depth_images_enter_like_colour_and_like_scans() -> None:
    grey = ImageFormat(2, 9, 1, "uint8")
    values = to_network(torch.full((3, 2, 9, 1), 255, dtype=torch.uint8), grey)
    assert values.shape == (3, 1, 2, 9) and (values == 0.5).all()
    depth = ImageFormat(2, 9, 1, "float32", depth_gain_m=2.0, depth_softening_m=1.0)
    values = to_network(torch.tensor([1.0, torch.inf]).reshape(1, 1, 2, 1), depth)
    assert values.flatten().tolist() == [1.0, 0.0]


def test_larger_pictures_are_averaged_and_their_depths_taken_from_the_middle() -> None:
    picture = np.arange(5 * 7 * 1, dtype=np.uint8).reshape(5, 7, 1)
    small = reduced(picture, 2)
    assert small.shape == (2, 3, 1) and small.dtype == np.uint8
    assert small[0, 0, 0] == round((0 + 1 + 7 + 8) / 4) and small[1, 2, 0] == round((18 + 19 + 25 + 26) / 4 + 0.01)
    depth = np.full((4, 4, 4), 0.5, np.float32)
    depth[..., 3] = np.inf
    depth[1, 1, 3] = 2.0
    found = reduced(depth, 2)
    np.testing.assert_array_equal(found[..., :3], 0.5)
    np.testing.assert_array_equal(found[..., 3], [[2.0, np.inf], [np.inf, np.inf]])


def test_an_observation_is_reduced_as_the_format_says_and_no_other_size_is_taken() -> None:
    image = ImageFormat(60, 80, 3, "uint8", reduction=8)
    assert observation(image, np.zeros((480, 640, 3), np.uint8)).shape == (60, 80, 3)
    assert observation(image, np.zeros((487, 647, 3), np.uint8)).shape == (60, 80, 3)
    for shape in ((60, 80, 3), (480, 648, 3), (480, 640, 1)):
        with pytest.raises(ValueError, match="expected 640 x 480 pixels of 3 x uint8"):
            observation(image, np.zeros(shape, np.uint8))
    with pytest.raises(ValueError, match="reduction is 0"):
        ImageFormat(60, 80, 3, "uint8", reduction=0)
