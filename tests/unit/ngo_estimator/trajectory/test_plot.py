"""The plot of a run shows each estimate and the truth, and is the same file for the same trajectories."""

from pathlib import Path

import numpy as np
from PIL import Image

from ngo_estimator.trajectory.plot import save_plot

POSES = np.column_stack((np.linspace(0.0, 5.0, 200), np.sin(np.linspace(0.0, 5.0, 200)), np.zeros(200)))


def colours(path: Path) -> set[tuple[int, ...]]:
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    return {tuple(colour) for colour in np.unique(pixels, axis=0).tolist()}


def test_what_is_drawn(tmp_path: Path) -> None:
    blue, green, orange = (0x1F, 0x6F, 0xD6), (0x2C, 0xA0, 0x2C), (0xFF, 0x7F, 0x0E)
    estimates = {"odometry": POSES + 0.3, "corrected": POSES + 0.1}
    save_plot(tmp_path / "with.png", "a drive", estimates, POSES)
    save_plot(tmp_path / "again.png", "a drive", estimates, POSES)
    save_plot(tmp_path / "without.png", "a drive", estimates)
    assert {blue, green, orange} <= colours(tmp_path / "with.png")
    assert {green, orange} <= colours(tmp_path / "without.png") and blue not in colours(tmp_path / "without.png")
    assert (tmp_path / "with.png").read_bytes() == (tmp_path / "again.png").read_bytes()


def test_a_long_drive_makes_no_larger_picture(tmp_path: Path) -> None:
    save_plot(tmp_path / "long.png", "long", {"odometry": np.repeat(POSES, 1000, axis=0)})
    save_plot(tmp_path / "short.png", "long", {"odometry": POSES})
    assert (tmp_path / "long.png").stat().st_size < 1.2 * (tmp_path / "short.png").stat().st_size


def test_a_straight_path_leaves_its_panels_their_height(tmp_path: Path) -> None:
    straight = np.column_stack((np.linspace(0.0, 40.0, 200), np.zeros(200), np.zeros(200)))
    for turned in (straight, straight[:, (1, 0, 2)]):
        save_plot(tmp_path / "a.png", "a corridor", {"odometry": turned, "corrected": turned}, walls=turned[:, :2])
        width, height = Image.open(tmp_path / "a.png").size
        assert 1.5 < width / height < 4.0
        pixels = np.asarray(Image.open(tmp_path / "a.png").convert("L")) < 250
        rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
        assert np.ptp(rows) > 0.6 * height and np.ptp(columns) > 0.8 * width
