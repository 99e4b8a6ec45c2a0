"""The feature store and what the optimizer's training takes from it."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import load_local, load_place, write_untrained
from ngo_estimator.geometry import se2
from training import featurise
from training.data.batches import mirrored as mirrored_batch
from training.data.batches import relative_poses
from training.data.data_source import MIRRORED_STORE, OTHER_TRAIN_STORE, TRAIN_STORE
from training.data.drive_plan import drives_of_table
from training.data.episodes import images_of, mirrored_episode, simulate
from training.data.feature_store import check_networks, open_store
from training.data.features import features_of
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, WORLDS
from training.featurise import planned_drives

from .stores import SHAPES


def test_a_store_that_lacks_an_array_or_a_trajectory_is_refused(store: Path) -> None:
    assert set(open_store(store)) == set(SHAPES)
    (store / "done.1of2.json").write_text("[]")
    with pytest.raises(ValueError, match=r"lacks 1 of 2 groups.*featurise"):
        open_store(store)
    (store / "codes.npy").unlink()
    with pytest.raises(ValueError, match=r"lacks \['codes'\].*featurise"):
        open_store(store)


def test_features_of_other_networks_are_refused(store: Path) -> None:
    first, second = {"sha256": "a"}, {"sha256": "b"}
    check_networks(store, first, second)
    (store / "networks.json").write_text(json.dumps(["a", "b"]))
    check_networks(store, first, second)
    with pytest.raises(ValueError, match="made with other networks"):
        check_networks(store, first, first)


def test_a_store_begun_with_another_number_of_trajectories_is_refused_before_any_is_made(tmp_path: Path) -> None:
    write_untrained(tmp_path / "weights" / "maze3d", "maze3d")
    features = tmp_path / "maze3d" / "features"
    (features / "train_policy").mkdir(parents=True)
    np.save(features / "train_policy" / "relative.npy", np.zeros((3, 1000, 3)))
    arguments = featurise.Arguments("maze3d", trajectories=8, weights=tmp_path / "weights", out=tmp_path)
    with pytest.raises(ValueError, match=r"train_policy was begun with 3 trajectories, 2 are asked for; expected"):
        featurise.main(arguments)
    assert [entry.name for entry in features.iterdir()] == ["train_policy"]


def test_a_group_of_a_store_is_driven_as_its_seeds_say() -> None:
    world = dataclasses.replace(WORLDS["maze2d"], episode_frames=20)
    driven = drives_of_table(world, "cycles", "validation", 10)
    assert driven.mazes == driven.seeds == list(world.table_seeds("cycles", "validation")[:10])
    second = list(driven.episodes(world, slice(8, 16)))
    assert len(second) == 2
    expected = simulate(world, driven.seeds[8:], 21, world.tables["cycles"].size)
    for found, episode in zip(second, expected, strict=True):
        np.testing.assert_array_equal(found.poses_xyyaw, episode.poses_xyyaw)


def test_another_driver_drives_a_fifth_as_many_more_mazes_for_the_optimizer_alone() -> None:
    counts = {"validation_trajectories": 0, "test_trajectories": 0}
    world = WORLDS["maze3d"]
    driven = planned_drives(featurise.Arguments("maze3d", trajectories=42, **counts), world)
    ours, others = (driven[name] for name in world.optimizer_stores)
    assert (ours.driver, others.driver) == ("random_goals", "learned")
    assert (len(ours.seeds), len(others.seeds)) == (42, 9) and others.mazes == others.seeds
    assert not {*ours.seeds} & {*others.seeds} and all(seed in OPTIMIZER_TRAIN_SEEDS for seed in others.seeds)
    assert not planned_drives(featurise.Arguments("maze3d", trajectories=0, **counts), world)[OTHER_TRAIN_STORE].seeds
    world = WORLDS["maze2d"]
    assert world.optimizer_stores == (TRAIN_STORE,)
    assert OTHER_TRAIN_STORE not in planned_drives(featurise.Arguments("maze2d", **counts), world)


def test_trajectories_are_kept_as_a_mirror_shows_them_where_that_is_asked_for() -> None:
    world, counts = WORLDS["maze2d"], {"validation_trajectories": 0, "test_trajectories": 0}
    driven = planned_drives(featurise.Arguments("maze2d", mirror_drives=True, **counts), world)
    assert driven[MIRRORED_STORE] == driven[TRAIN_STORE]
    assert MIRRORED_STORE not in planned_drives(featurise.Arguments("maze2d", **counts), world)
    (episode,) = simulate(world, [3], 40)
    mirrored = mirrored_episode(world, episode)
    assert {0, 1, 2} <= set(episode.actions.tolist())
    # What a network of pairs learns from in a mirror is the same.
    steps, seen = (relative_poses(one.poses_xyyaw) for one in (episode, mirrored))
    torch.testing.assert_close(seen, steps * torch.tensor([1.0, -1.0, -1.0]))
    batch = {"images": images_of(world, episode), "action": torch.from_numpy(episode.actions).long()}
    expected = mirrored_batch(batch)
    assert torch.equal(images_of(world, mirrored), expected["images"])
    assert mirrored.actions.tolist() == expected["action"].tolist()
    again = mirrored_episode(world, mirrored)
    np.testing.assert_array_equal(again.observations, images_of(world, episode).numpy())
    np.testing.assert_array_equal(again.poses_xyyaw, episode.poses_xyyaw)


def test_features_are_what_the_networks_say_frame_by_frame(tmp_path: Path) -> None:
    world = WORLDS["maze2d"]
    write_untrained(tmp_path, world.name)
    local, place = load_local(tmp_path)[0], load_place(tmp_path)[0]
    (episode,) = simulate(world, [3], 300)  # more than one chunk
    arrays = features_of(world, episode, tmp_path, (local, place))
    assert {name: value.shape[0] for name, value in arrays.items()} == {**dict.fromkeys(SHAPES, 299), "origin_code": 1}
    images = torch.from_numpy(episode.observations).reshape(-1, *world.image.shape)
    for k in (0, 255, 256, 298):
        relative, log_std, motion = local(
            images[k : k + 1], images[k + 1 : k + 2], torch.tensor([int(episode.actions[k])])
        )
        np.testing.assert_allclose(arrays["relative"][k], relative[0], atol=1e-5)
        np.testing.assert_allclose(arrays["log_std"][k], log_std[0], atol=1e-4)
        np.testing.assert_allclose(arrays["motion"][k], motion[0], atol=2e-3, rtol=2e-3)
        np.testing.assert_allclose(arrays["codes"][k], place.encoder(images[k + 1 : k + 2])[0], atol=1e-2, rtol=1e-2)
    truth = se2.between(torch.from_numpy(episode.poses_xyyaw[:1]), torch.from_numpy(episode.poses_xyyaw[1:]))
    np.testing.assert_allclose(arrays["truth"], truth, atol=1e-12)
