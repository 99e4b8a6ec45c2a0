"""What 3D mazes look like in training: drawn within ranges, never as held out, and nothing changes without looks."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_sim.doom_map import TEXTURE_SETS
from ngo_sim.maze3d import Maze3DConfig
from training import train_local, train_place
from training.common import runs
from training.data.looks import HELD_OUT, MEASURED_LOOKS, TRAINING_LOOKS, Looks
from training.data.streams import PairStream, simulate
from training.data.worlds import TRAIN_SEEDS, WORLDS, World, world_looking

WORLD = WORLDS["maze3d"]
SCRIPTS = (train_local, train_place)


def config_of(world: World, seed: int) -> Maze3DConfig:
    env = world.make_random(np.random.default_rng(seed))
    config: Maze3DConfig = env.unwrapped.config  # type: ignore[attr-defined]
    env.close()
    return config


def test_held_out_textures_are_those_of_no_training() -> None:
    trained = {name for looks in TRAINING_LOOKS.values() for name in looks.textures}
    assert trained | {HELD_OUT} == set(TEXTURE_SETS) - {"all"} and HELD_OUT not in trained
    assert set(TRAINING_LOOKS["plain"].textures) < set(TRAINING_LOOKS["varied"].textures)
    assert [looks.textures for name, looks in MEASURED_LOOKS.items() if name != "plain"] == [(HELD_OUT,)] * 2
    held_out = {*TEXTURE_SETS[HELD_OUT].walls, *TEXTURE_SETS[HELD_OUT].flats}
    for looks in TRAINING_LOOKS.values():
        for name in looks.textures:
            assert not held_out & {*TEXTURE_SETS[name].walls, *TEXTURE_SETS[name].flats}


def test_the_plain_look_is_the_simulators_own_but_for_its_textures() -> None:
    config = Maze3DConfig(**TRAINING_LOOKS["plain"].draw(np.random.default_rng(0)))
    assert config == Maze3DConfig(textures="stone")
    assert Maze3DConfig(**Looks().draw(np.random.default_rng(0))) == Maze3DConfig()


@pytest.mark.parametrize("name", MEASURED_LOOKS)
def test_a_simulator_takes_all_that_is_drawn(name: str) -> None:
    looks, rng = MEASURED_LOOKS[name], np.random.default_rng(0)
    for _ in range(50):
        config = Maze3DConfig(**looks.draw(rng))
        assert config.textures in looks.textures
        for field in ("light_level", "block_m", "decorations"):
            low, high = getattr(looks, field)
            assert low <= getattr(config, field) <= high


def test_training_mazes_have_looks_of_their_ranges_and_all_sets() -> None:
    varied = world_looking("maze3d", "varied")
    configs = [config_of(varied, seed) for seed in range(30)]
    assert {config.textures for config in configs} == {"stone", "brick", "tech"}
    for field in ("light_level", "block_m", "decorations"):
        low, high = getattr(TRAINING_LOOKS["varied"], field)
        values = [getattr(config, field) for config in configs]
        assert low <= min(values) < low + (high - low) / 4 and high - (high - low) / 4 < max(values) <= high


def test_without_looks_and_with_them_mazes_are_as_large_and_as_open() -> None:
    for seed in range(10):
        bare, varied = config_of(WORLD, seed), config_of(world_looking("maze3d", "varied"), seed)
        size = {"rows": bare.rows, "cols": bare.cols, "extra_openings": bare.extra_openings}
        assert bare == Maze3DConfig(**size)
        assert (varied.rows, varied.cols, varied.extra_openings) == tuple(size.values())


def test_held_out_textures_alone_leave_every_way_as_it_was() -> None:
    plain, held_out, varied = (
        next(simulate(dataclasses.replace(WORLD, looks=looks), [5], 40)) for looks in MEASURED_LOOKS.values()
    )
    np.testing.assert_array_equal(plain.poses_xyyaw, held_out.poses_xyyaw)
    np.testing.assert_array_equal(plain.actions, held_out.actions)
    assert (plain.observations != held_out.observations).any(axis=-1).mean() > 0.5
    assert varied.maze.block_m != held_out.maze.block_m
    np.testing.assert_array_equal(varied.maze.walls, held_out.maze.walls)


def test_a_default_training_gets_the_pictures_it_has_always_got() -> None:
    assert world_looking("maze3d", None) is WORLD and WORLD.looks is None
    group = PairStream(WORLD, TRAIN_SEEDS, 0, 1, 32).groups[0]
    env = WORLD.make_random(np.random.default_rng(group[0]))
    first, _ = env.reset(seed=group[0])
    env.close()
    bare = WORLD.make(env.unwrapped.config.rows, env.unwrapped.config.extra_openings)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(first, bare.reset(seed=group[0])[0])
    bare.close()


@pytest.mark.parametrize("script", SCRIPTS)
def test_only_the_3d_world_has_looks(script: Any) -> None:
    with pytest.raises(ValueError, match="looks is 'varied' with maze2d; expected none: only maze3d has looks"):
        script.Arguments(world="maze2d", looks="varied")
    with pytest.raises(ValueError, match="looks is 'plain' with scan"):
        script.Arguments(world="scan", looks="plain")
    with pytest.raises(ValueError, match="with maze2d; expected none"):
        dataclasses.replace(WORLDS["maze2d"], looks=Looks())


@pytest.mark.parametrize("script", SCRIPTS)
def test_each_look_is_a_run_of_its_own_and_runs_from_before_there_were_looks_go_on(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Begun(Exception):
        pass

    folders: list[Path] = []

    def begin(folder: Path, *_: Any, **__: Any) -> None:
        folders.append(folder)
        raise Begun

    monkeypatch.setattr(script.runs, "Run", begin)
    for looks in (None, "plain", "varied"):
        with pytest.raises(Begun):
            script.main(script.Arguments(world="maze3d", looks=looks, runs=tmp_path))
    kind = script.__name__.rpartition("_")[2]
    assert [folder.relative_to(tmp_path / "maze3d").name for folder in folders] == [
        kind, f"{kind}-plain", f"{kind}-varied"]  # fmt: skip
    monkeypatch.undo()

    (tmp_path / "old").mkdir()
    arguments = script.Arguments(world="maze3d")
    old = {k: v for k, v in runs.record("script", arguments)["arguments"].items() if k != "looks"}
    (tmp_path / "old" / "run.json").write_text(json.dumps({"arguments": old, "resumed": []}))
    (tmp_path / "old" / "last.ckpt").touch()
    runs.Run(tmp_path / "old", "script", arguments, 1, 0)
    with pytest.raises(runs.RunError, match="given looks plain; expected looks None"):
        runs.Run(tmp_path / "old", "script", dataclasses.replace(arguments, looks="plain"), 1, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"textures": ()}, "textures is "),
        ({"light_level": (200, 100)}, r"light_level is \(200, 100\); expected a lower end"),
        ({"decorations": (-1, 3)}, r"decorations is \(-1, 3\)"),
    ],
)
def test_looks_that_cannot_be_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Looks(**change)
