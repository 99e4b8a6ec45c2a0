"""Images and scans as the networks take them."""

import math
import time

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ngo_estimator.checkpoint import WORLD_IMAGES
from ngo_estimator.data.images import ImageFormat, reduced, scan_image, to_network
from ngo_estimator.data.observations import observation
from tests.unit.ngo_estimator.samples import SCAN


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


EIGHT = ImageFormat(1, 9, 1, "float32", field_of_view_deg=360.0)  # a ray every 45 degrees, from back over left


def test_a_scan_of_the_formats_own_rays_is_taken_as_it_is() -> None:
    ranges = np.array([1, 2, 3, 4, 5, 6, 7, 8, 1], np.float32)  # the first and the last look straight back
    taken = scan_image(EIGHT, ranges, math.pi, -math.pi / 4, 0.0, 100.0)
    np.testing.assert_array_equal(taken, ranges.reshape(1, 9, 1))
    assert taken.dtype == np.float32


def room(angles_rad: np.ndarray) -> np.ndarray:
    """Ranges to the walls of a room of 6 x 4 m, from its middle."""
    with np.errstate(divide="ignore", over="ignore"):
        return np.minimum(3.0 / np.abs(np.cos(angles_rad)), 2.0 / np.abs(np.sin(angles_rad)))


@settings(max_examples=60, deadline=None)
@given(rays=st.integers(300, 2000), begin=st.floats(-10.0, 10.0), clockwise=st.booleans())
def test_a_whole_turn_is_the_same_wherever_and_whichever_way_it_begins(
    rays: int, begin: float, clockwise: bool
) -> None:
    increment = math.tau / rays * (-1.0 if clockwise else 1.0)
    seen = scan_image(SCAN, room(begin + increment * np.arange(rays)), begin, increment, 0.1, 30.0).ravel()
    # Exact on the walls, a little off beside the corners.
    np.testing.assert_allclose(seen, room(SCAN.ray_angles_rad), rtol=0.02)


def test_left_stays_left() -> None:
    # Counter-clockwise from -90 to +90 degrees, as most drivers give it: a wall on the left alone.
    angles = np.radians(np.arange(-90.0, 91.0))
    ranges = np.where(angles > 0.1, 1.0, 5.0)
    seen = scan_image(SCAN, ranges, angles[0], math.radians(1.0), 0.0, 30.0).ravel()
    left = SCAN.ray_angles_rad > 0.15
    looked_at = np.abs(SCAN.ray_angles_rad) <= math.pi / 2 + 0.005
    assert (seen[left & looked_at] == 1.0).all() and (seen[~left & looked_at][20:] == 5.0).all()
    assert np.isinf(seen[~looked_at]).all()


@pytest.mark.parametrize(("begin_deg", "end_deg"), [(-150, 150), (-45, 45), (0, 90), (170, 300)])
def test_what_the_scanner_does_not_look_at_has_no_return(begin_deg: int, end_deg: int) -> None:
    angles = np.radians(np.arange(begin_deg, end_deg + 1))
    seen = scan_image(SCAN, np.full(len(angles), 2.0), angles[0], math.radians(1.0), 0.0, 30.0).ravel()
    degrees = np.degrees(SCAN.ray_angles_rad)
    inside = np.zeros(len(degrees), np.bool_)
    for turn in (-360, 0, 360):
        inside |= (degrees + turn >= begin_deg - 0.5) & (degrees + turn < end_deg + 0.5)
    np.testing.assert_array_equal(np.isfinite(seen), inside)


def test_a_fine_scanner_may_lose_rays_that_others_stand_for() -> None:
    angles = np.radians(np.arange(0, 720) / 2.0)
    lost = room(angles)
    lost[::2] = np.inf  # every other ray, half a degree beside one that is left
    seen = scan_image(SCAN, lost, 0.0, math.radians(0.5), 0.0, 30.0).ravel()
    np.testing.assert_allclose(seen, room(SCAN.ray_angles_rad), rtol=0.05)
    lost[np.arange(720) % 10 != 1] = (
        np.inf
    )  # one in 5 degrees is left, at 0.5: only the format's ray at 0 is near enough
    seen = scan_image(SCAN, lost, 0.0, math.radians(0.5), 0.0, 30.0).ravel()
    degrees = np.degrees(SCAN.ray_angles_rad)
    np.testing.assert_array_equal(np.isfinite(seen), np.abs((degrees - 0.5 + 2.5) % 5.0 - 2.5) <= 0.625)
    coarse = np.array([2.0, np.inf, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0])
    seen = scan_image(EIGHT, coarse, -math.pi, math.pi / 4, 0.0, 30.0).ravel()
    assert np.isinf(seen).tolist() == [False] * 7 + [True, False]  # no other ray looks there


@settings(max_examples=100, deadline=None)
@given(
    rays=st.integers(2, 400),
    step_deg=st.floats(0.1, 5.0),
    begin=st.floats(-4.0, 4.0),
    clockwise=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_the_nearest_return_stands_for_a_lost_ray(
    rays: int, step_deg: float, begin: float, clockwise: bool, seed: int
) -> None:
    """Against a search among all rays, one by one; every range differs, and none is interpolated."""
    rng = np.random.default_rng(seed)
    step = math.radians(step_deg)
    ranges = np.where(rng.random(rays) < 0.2, 1.5 ** np.arange(rays).clip(0, 60), np.inf).astype(np.float32)
    seen = scan_image(EIGHT, ranges, begin, -step if clockwise else step, 0.0, math.inf).ravel()
    for angle, found in zip(EIGHT.ray_angles_rad, seen, strict=True):
        turn = (begin - angle if clockwise else angle - begin) + 0.5 * step
        place = (turn % math.tau - 0.5 * step) / step
        every = np.flatnonzero(np.isfinite(ranges))
        away = np.abs(every - place)
        closed = rays * step > math.tau - 0.5 * step
        if closed:
            away = np.minimum(np.minimum(away, np.abs(every + rays - place)), np.abs(every - rays - place))
        near = every[away <= away.min(initial=math.inf) + 1e-6]
        looked_at = closed or math.floor(place + 0.5) < rays
        if not looked_at or away.min(initial=math.inf) > max(0.5, math.radians(22.5) / step):
            assert np.isinf(found)
        elif abs(away.min() - math.radians(22.5) / step) > 1e-6:
            assert found in ranges[near]


@pytest.mark.parametrize("rays", [2, 600_000])
def test_no_increment_makes_a_scan_expensive(rays: int) -> None:
    began = time.process_time()
    for increment in (1e-9, 1e-12, 5e-324, -1e-7):
        with pytest.raises(ValueError, match="an increment from 1e-05 to below pi"):
            scan_image(EIGHT, np.full(rays, np.inf), 0.0, increment, 0.0, 30.0)
    for increment in (1e-5, -1e-5, 3.0):
        scan_image(EIGHT, np.full(rays, np.inf), 0.0, increment, 0.0, 30.0)
        scan_image(EIGHT, np.where(np.arange(rays) % 2, 1.0, np.inf), 0.0, increment, 0.0, 30.0)
    assert time.process_time() - began < 2.0


def test_between_two_rays_one_surface_is_interpolated_and_an_edge_is_not() -> None:
    # Rays 22.5 degrees beside those of the format: each of its rays lies in the middle of two.
    ranges = np.array([2.0, 2.2, 2.0, 2.0, 4.0, 4.0, 4.0, 2.0])
    seen = scan_image(EIGHT, ranges, -math.pi + math.pi / 8, math.pi / 4, 0.0, 30.0).ravel()
    between = seen[::-1]  # counter-clockwise from the back
    assert between[1] == pytest.approx(2.1) and between[2] == pytest.approx(2.1) and between[3] == 2.0
    assert set(between[[4, 7]].tolist()) <= {2.0, 4.0}


def test_a_scan_enters_the_network_with_no_return_as_zero() -> None:
    image = np.full(SCAN.shape, np.inf, np.float32)
    image[0, 7, 0] = 0.75
    image[0, 8, 0] = 0.0
    values = to_network(torch.from_numpy(image), SCAN).flatten()
    assert values.shape == (289,) and values[7] == 1.0 and values[8] == 2.0
    assert values.count_nonzero() == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ranges": np.ones((2, 5))}, r"ranges of shape \(2, 5\)"),
        ({"ranges": np.ones(1)}, "two at least"),
        ({"angle_increment_rad": 0.0}, "angle_increment 0; expected"),
        ({"angle_min_rad": math.nan}, "angle_min nan"),
    ],
)
def test_a_geometry_that_no_scanner_has_is_refused(change: dict[str, object], words: str) -> None:
    scan = {"angle_min_rad": -1.0, "angle_increment_rad": 0.1, "range_min_m": 0.0, "range_max_m": 9.0}
    with pytest.raises(ValueError, match=words):
        scan_image(SCAN, **{"ranges": np.ones(20), **scan, **change})  # type: ignore[arg-type]
