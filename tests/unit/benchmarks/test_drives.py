"""A drive in parts is the whole drive, is made once, and is what the core takes."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import drives
from benchmarks.drives import Drive, drive_of, episodes, stamp_ns
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_sim.episodes import record_episode
from training.common.records import WEIGHTS
from training.data.worlds import world_named


def test_the_parts_of_a_drive_follow_each_other() -> None:
    size = drives.SIZES["maze2d"]
    env = world_named("maze2d").make(size.rows, size.extra_openings)
    whole = record_episode(env, "corners", 26, 2000)
    parts = list(episodes("maze2d", 2000, 25, chunk=10))
    assert [len(part.actions) for part in parts] == [10, 10, 5]
    for name, least in (("observations", 1), ("poses_xyyaw", 1), ("actions", 0)):
        joined = np.concatenate([getattr(parts[0], name), *(getattr(part, name)[least:] for part in parts[1:])])
        assert np.array_equal(joined, getattr(whole, name)), name


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def drive(cache: Path) -> Drive:
    return drive_of("maze2d", 2000, 40, cache)


def test_a_drive_is_the_same_in_any_parts(cache: Path, drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drives, "_CHUNK", 16)
    parts = list(episodes("maze2d", 2000, 40, chunk=16))
    monkeypatch.setattr(drives, "episodes", lambda *_: iter(parts))
    again = drive_of("maze2d", 2000, 40, cache / "another")
    for name, value in vars(drive).items():
        assert getattr(again, name) == pytest.approx(np.asarray(value), abs=1e-2), name
    assert np.array_equal(again.truth, drive.truth)


def test_the_core_takes_the_steps(drive: Drive) -> None:
    core = OnlineTrajectory.load(WEIGHTS / "maze2d", 2000, "maze2d")
    for step in drive.steps():
        update = core.update(step)
        assert not update.gap
        assert not update.restarted
    trajectory = core.trajectory()
    assert trajectory is not None
    assert trajectory.stamps_ns.tolist() == [stamp_ns(frame) for frame in range(41)]
    assert trajectory.odometry_xyyaw[1:] == pytest.approx(drive.odometry())
