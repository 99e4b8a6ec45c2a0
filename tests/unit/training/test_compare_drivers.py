import json
from pathlib import Path

import numpy as np
import pytest

from ngo_sim.episodes import Episode
from ngo_sim.mazes import Maze
from training.compare_drivers import Arguments, main, measure


def test_way_and_ground_of_a_known_path() -> None:
    walls = np.ones((5, 5), dtype=bool)
    walls[1, 1:4] = False
    # Three metres to and fro, in two blocks of three metres.
    x = np.array([4.5, 5.5, 6.5, 7.5, 6.5, 5.5, 4.5])
    poses = np.stack((x, np.full(7, 4.5), np.zeros(7)), axis=1)
    episode = Episode(np.zeros((7, 1)), np.zeros(6, np.uint8), poses, 0.1, Maze(walls, block_m=3.0))
    assert measure(episode) == (6.0, 4, 2)


def test_the_table_has_every_driver_beside_the_random_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = main(Arguments(world="maze2d", trajectories=2, frames=150, drivers=("corners",), out=tmp_path))
    assert list(table) == ["corners", "random"]
    assert table["random"]["way_m"]["times_random"] == 1.0
    assert table["corners"]["way_m"]["times_random"] > 1.5
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["drivers"] == table
    assert json.loads((tmp_path / "maze2d_drivers.json").read_text()) == last


def test_what_cannot_be_is_refused() -> None:
    for changes, expected in (
        ({"trajectories": 1}, "trajectories is 1; it must be from 2 to 1000"),
        ({"frames": 1}, "frames is 1; it must be at least 2"),
        ({"drivers": ("fast",)}, r"drivers has \['fast'\]; they must be among corners"),
    ):
        with pytest.raises(ValueError, match=expected):
            Arguments(**changes)
