"""Training data: a function of the epoch's number, dealt out once, mirrored as physics would have it."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.networks.local_pose_network import NO_ACTION
from ngo_sim.drivers import Action
from ngo_sim.episodes import Episode
from training.data.batches import ACTION_HISTORY, Batch, Share, action_histories, mirrored, relative_poses
from training.data.episodes import episodes_in, images_of, simulate, wall_ranges
from training.data.streams import PairStream, PlaceStream, TrajectoryStream, loader, partly_forgotten, revisits
from training.data.worlds import DRAWN, TRAIN_SEEDS, WORLDS, World

WORLD = WORLDS["maze2d"]


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.data.episodes.GROUP", 2)
    monkeypatch.setattr(PairStream, "FRAMES", 41)
    monkeypatch.setattr(PlaceStream, "FRAMES", 400)


def pair_stream(epoch: int = 0, groups: int = 2, batch_size: int = 16) -> PairStream:
    return PairStream(WORLD, TRAIN_SEEDS, epoch, groups * 2 * 40, batch_size)


def same(a: Batch, b: Batch) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_an_epoch_is_a_function_of_its_number() -> None:
    first, again, second = (list(pair_stream(epoch)) for epoch in (3, 3, 4))
    assert len(first) == len(pair_stream(3)) == 2 * (2 * 40 // 16)
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert not any(same(a, b) for a, b in zip(first, second, strict=True))


def test_epochs_never_meet_the_same_maze() -> None:
    seen = [seed for epoch in range(5) for group in pair_stream(epoch).groups for seed in group]
    assert len(seen) == len(set(seen)) == 5 * 4
    assert all(seed in TRAIN_SEEDS for seed in seen)


def test_workers_share_the_groups_without_overlap() -> None:
    alone = list(pair_stream(groups=3))
    shared = list(loader(pair_stream(groups=3), workers=2))
    assert len(shared) == len(alone)
    rest = list(alone)
    for batch in shared:
        match = [index for index, other in enumerate(rest) if same(batch, other)]
        assert len(match) == 1
        rest.pop(match[0])
    assert not rest


@pytest.mark.parametrize("groups", [4, 5])
def test_processes_that_train_together_get_as_many_mazes_of_their_own(groups: int) -> None:
    def dealt(epoch: int, share: Share) -> PairStream:
        return PairStream(WORLD, TRAIN_SEEDS, epoch, groups * 2 * 40, 16, share)

    shares = [[dealt(epoch, Share(rank, 2)) for rank in range(2)] for epoch in range(2)]
    assert all(len(first) == len(second) == len(list(first)) for first, second in shares)
    seen = [seed for streams_ in shares for stream in streams_ for group in stream.groups for seed in group]
    mazes_an_epoch = 2 * (4 if groups == 4 else 6)
    assert len(seen) == len(set(seen)) == 2 * mazes_an_epoch
    if groups == 4:  # what one process would have met, and nothing else
        assert set(seen) == {seed for epoch in range(2) for group in dealt(epoch, Share()).groups for seed in group}


def test_pairs_are_consecutive_frames_with_their_action_and_motion() -> None:
    episodes = list(simulate(WORLD, pair_stream(groups=1).groups[0], 41))
    known = {}
    for episode in episodes:
        images, relative = images_of(WORLD, episode), relative_poses(episode.poses_xyyaw)
        for k in range(40):
            known[images[k].numpy().tobytes()] = (images[k + 1], episode.actions[: k + 1].tolist(), relative[k])
    batches = list(pair_stream(groups=1))
    assert batches[0]["earlier"].shape == (16, 1, 241, 4) and batches[0]["relative"].dtype == torch.float32
    seen = forgotten = 0
    for count, batch in enumerate(batches):
        plain = mirrored(batch) if count % 2 else batch  # every second batch is a mirror image
        for k in range(16):
            later, actions, relative_pose = known.pop(plain["earlier"][k].numpy().tobytes())
            assert torch.equal(plain["later"][k], later)
            told = [action for action in plain["action"][k].tolist() if action != NO_ACTION]
            assert told == actions[-len(told) :] and plain["action"][k][-1] != NO_ACTION
            forgotten += len(told) < min(len(actions), ACTION_HISTORY)
            assert torch.equal(plain["relative"][k], relative_pose)
            seen += 1
    assert seen == 80 and not known  # every pair once
    assert 0 < forgotten < 20


def test_left_turns_turn_left_and_a_mirror_image_shows_them_as_right() -> None:
    """The three conventions at once: actions, headings and the order of columns."""
    env = WORLD.make(5, 0)
    observation, info = env.reset(seed=11)
    poses = [info["pose_xyyaw"]]
    for _ in range(10):
        observation, _, _, _, info = env.step(Action.TURN_LEFT)
        poses.append(info["pose_xyyaw"])
    relative = relative_poses(np.stack(poses))
    assert relative[:, 2].sum() > 0.3
    batch = mirrored({"relative": relative, "earlier": torch.from_numpy(observation.reshape(1, 1, 241, 4))})
    assert batch["relative"][:, 2].sum() < -0.3
    np.testing.assert_array_equal(batch["earlier"][0, 0].numpy(), observation[::-1])


# ---- places


def test_revisits_on_paper() -> None:
    world = dataclasses.replace(WORLD, place_radius_m=0.5, heading_limit_rad=0.4)
    poses = np.array(
        [
            [0.0, 0.0, 0.0],
            [0.1, 0.0, 0.0],  # too soon after 0
            [0.3, 0.3, 0.3],  # near 0 and 1
            [0.0, 0.4, 0.5],  # turned too far from 0 and 1
            [0.5, 0.0, 2.0 * np.pi + 0.1],  # exactly the radius from 0: no longer near; near 1; a full turn is none
            [9.0, 9.0, 0.0],
        ]
    )
    assert revisits(poses, world, 2).tolist() == [[0, 2], [1, 4], [2, 4]]
    assert revisits(poses, world, 3).tolist() == [[1, 4]]
    assert revisits(poses, world, 6).shape == (0, 2)


def test_place_pairs_are_near_in_space_apart_in_time_and_from_both_mazes() -> None:
    stream = PlaceStream(WORLD, TRAIN_SEEDS, 0, 16, 12)
    batches = list(stream)
    assert len(batches) == len(stream) == 16
    for batch in batches[:4]:
        assert batch["a"].shape == batch["b"].shape == (24, 1, 241, 4)
        assert batch["poses"].shape == (24, 2, 3) and batch["poses"].dtype == torch.float32
        distance = (batch["poses"][:, 0, :2] - batch["poses"][:, 1, :2]).norm(dim=1)
        assert distance.max() < WORLD.place_radius_m
        assert batch["maze"].tolist() == [0] * 12 + [1] * 12
    again = list(PlaceStream(WORLD, TRAIN_SEEDS, 0, 16, 12))
    assert all(same(a, b) for a, b in zip(batches, again, strict=True))


def test_where_ranges_are_learned_place_pairs_come_with_the_true_ones() -> None:
    world = WORLDS["maze3d"]
    registration = world.registration
    assert registration is not None
    stream = PlaceStream(world, TRAIN_SEEDS, 0, 16, 4)
    batch, in_mirror = list(stream)[:2]
    assert batch["ranges"].shape == (8, 2, registration.rays) and batch["ranges"].min() > 0.3
    assert batch["ranges"].max() < 60.0
    mazes = [
        episode.maze for episode in episodes_in(world, *2 * [stream.groups[0]], 400, DRAWN, world.stream_drivers[0])
    ]
    for row in range(8):
        maze, poses = mazes[int(batch["maze"][row])], batch["poses"][row].double().numpy()
        assert maze is not None
        seen = wall_ranges(maze, poses, registration.angles_rad.double().numpy())
        np.testing.assert_allclose(np.median(np.abs(batch["ranges"][row] - seen), axis=-1), 0.0, atol=1e-3)
    turned = mirrored(in_mirror)
    assert torch.equal(turned["ranges"], in_mirror["ranges"].flip(-1)) and torch.equal(
        turned["a"], in_mirror["a"].flip(-2)
    )
    assert "ranges" not in next(iter(PlaceStream(WORLD, TRAIN_SEEDS, 0, 16, 4)))


def test_mazes_without_any_place_seen_twice_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlaceStream, "FRAMES", 60)
    monkeypatch.setattr(PlaceStream, "MIN_STEPS_APART", 55)
    with pytest.raises(
        ValueError,
        match=r"in none of 2 mazes of .* is a place seen twice .*; expected longer episodes or smaller mazes",
    ):
        list(PlaceStream(WORLD, TRAIN_SEEDS, 0, 16, 12))


# ---- whole trajectories


def test_each_trajectory_is_met_once_whole_and_every_second_batch_in_a_mirror(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.data.episodes.GROUP", 4)
    stream = TrajectoryStream(WORLD, TRAIN_SEEDS, 0, 4, 2, 60)
    batches = list(stream)
    assert len(batches) == len(stream) == 4
    for number, batch in enumerate(batches):
        assert batch["images"].shape == (2, 61, 1, 241, 4)
        plain = mirrored(batch) if number % 2 else batch
        group = stream.groups[number // 2]
        episodes = list(simulate(WORLD, group, 61))[number % 2 * 2 :][:2]
        for k, episode in enumerate(episodes):
            assert torch.equal(plain["images"][k], images_of(WORLD, episode))
            assert torch.equal(plain["action"][k], action_histories(episode.actions))
            again = se2.compose(torch.from_numpy(episode.poses_xyyaw[0]), se2.r2g(plain["relative"][k].double()))
            assert torch.allclose(again[:, :2], torch.from_numpy(episode.poses_xyyaw[1:, :2]), atol=1e-4)


def test_a_history_ends_with_the_steps_own_action_and_begins_with_nothing() -> None:
    histories = action_histories(np.array([[1, 2, 0], [0, 0, 1]], np.uint8))
    assert histories.shape == (2, 3, ACTION_HISTORY)
    for episode, actions in enumerate(([1, 2, 0], [0, 0, 1])):
        for step in range(3):
            unknown = [NO_ACTION] * (ACTION_HISTORY - step - 1)
            assert histories[episode, step].tolist() == unknown + actions[: step + 1]
    in_the_mirror = mirrored({"action": histories})["action"]
    assert in_the_mirror[0, 2].tolist()[-4:] == [NO_ACTION, 2, 1, 0]


def test_of_a_tenth_of_the_histories_the_earlier_part_is_forgotten() -> None:
    whole = torch.ones(10_000, 3, ACTION_HISTORY).long()
    partly = partly_forgotten(whole, np.random.default_rng(0))
    known = (partly != NO_ACTION).sum(-1)
    assert 0.08 < float((known[:, 0] < ACTION_HISTORY).float().mean()) < 0.12
    assert sorted(set(known[:, 0].tolist())) == list(range(1, ACTION_HISTORY + 1))
    assert all((row[-count:] == 1).all() for row, count in zip(partly[:, 0], known[:, 0].tolist(), strict=True))
    # As after a restart, each step knows one more.
    assert torch.equal(known, (known[:, :1] + torch.arange(3)).clamp(max=ACTION_HISTORY))


def test_the_training_drivers_take_turns_group_by_group(monkeypatch: pytest.MonkeyPatch) -> None:
    drove: list[tuple[int, str]] = []
    real = episodes_in

    def noted(world: World, mazes: list[int], *rest: Any) -> Iterator[Episode]:
        drove.append((mazes[0], rest[-1]))
        return real(world, mazes, *rest)

    monkeypatch.setattr("training.data.streams.episodes_in", noted)
    world = dataclasses.replace(WORLD, training_drivers=("corners", "random", "random_goals"))
    for rank in range(2):  # which process simulates a group does not matter
        list(PairStream(world, TRAIN_SEEDS, 1, 6 * 2 * 40, 16, Share(rank, 2)))
    first = TRAIN_SEEDS[0] + 6 * 2
    drivers = ["corners", "random", "random_goals"] * 2
    assert sorted(drove) == [(first + 2 * group, driver) for group, driver in enumerate(drivers)]
    drove.clear()
    list(pair_stream(groups=3))
    assert {driver for _, driver in drove} == {WORLD.driver}


def test_where_errors_over_windows_count_steps_of_the_longest_stay_together() -> None:
    world = dataclasses.replace(WORLD, error_windows=(1, 3, 7))
    stream = PairStream(world, TRAIN_SEEDS, 3, 2 * 40, 14)
    batches = list(stream)
    assert len(batches) == len(stream) == 2 * 5 * 7 // 14  # of 40 steps in each of two mazes, five stretches of seven
    episodes = list(simulate(world, stream.groups[0], 41))
    kept = [images_of(world, episode) for episode in episodes]
    met, starts = [], []
    for count, batch in enumerate(batches):
        shown = mirrored(batch) if count % 2 else batch
        for first in range(0, 14, 7):
            earlier, later = shown["earlier"][first : first + 7], shown["later"][first : first + 7]
            assert torch.equal(earlier[1:], later[:-1])
            (place,) = [
                (maze, step) for maze in range(2) for step in range(40) if torch.equal(kept[maze][step], earlier[0])
            ]
            starts.append(place)
            met += [(place[0], place[1] + k) for k in range(7)]
            own = torch.from_numpy(episodes[place[0]].actions[place[1] : place[1] + 7]).long()
            assert torch.equal(shown["action"][first : first + 7, -1], own)
            relative = relative_poses(episodes[place[0]].poses_xyyaw)[place[1] : place[1] + 7]
            torch.testing.assert_close(shown["relative"][first : first + 7], relative)
    assert sorted(met) == [(maze, step) for maze in range(2) for step in range(35)]
    assert starts != sorted(starts)
