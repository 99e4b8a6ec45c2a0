"""Training data: a function of the epoch's number, dealt out once, mirrored as physics would have it."""

import dataclasses

import numpy as np
import pytest
import torch

from ngo_estimator import se2
from ngo_sim.drivers import Action
from training import streams
from training.streams import (
    Batch,
    PairStream,
    PlaceStream,
    Share,
    TrajectoryStream,
    images_of,
    loader,
    mirrored,
    relative_poses,
    revisits,
    simulate,
)
from training.worlds import TRAIN_SEEDS, WORLDS

WORLD = WORLDS["maze2d"]


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "_GROUP", 2)
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


def test_an_epoch_beyond_the_seeds_is_refused() -> None:
    with pytest.raises(ValueError, match="epoch 3 asks for more than the 12 maze seeds"):
        PairStream(WORLD, range(10_000, 10_012), 3, 2 * 2 * 40, 16)


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


def test_a_share_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="rank is 2 of 2; expected 0 to 1"):
        Share(2, 2)


def test_making_data_in_the_training_process_leaves_its_threads_alone() -> None:
    before = torch.get_num_threads()
    next(iter(pair_stream()))
    assert torch.get_num_threads() == before


def test_pairs_are_consecutive_frames_with_their_action_and_motion() -> None:
    episodes = list(simulate(WORLD, pair_stream(groups=1).groups[0], 41))
    known = {}
    for episode in episodes:
        images, relative = images_of(WORLD, episode), relative_poses(episode.poses_xyyaw)
        for k in range(40):
            known[images[k].numpy().tobytes()] = (images[k + 1], int(episode.actions[k]), relative[k])
    batches = list(pair_stream(groups=1))
    assert batches[0]["earlier"].shape == (16, 1, 241, 4) and batches[0]["relative"].dtype == torch.float32
    seen = 0
    for count, batch in enumerate(batches):
        plain = mirrored(batch) if count % 2 else batch  # every second batch is a mirror image
        for k in range(16):
            later, action, relative_pose = known.pop(plain["earlier"][k].numpy().tobytes())
            assert torch.equal(plain["later"][k], later)
            assert plain["action"][k] == action
            assert torch.equal(plain["relative"][k], relative_pose)
            seen += 1
    assert seen == 80 and not known  # every pair once


def test_mirroring_twice_is_nothing() -> None:
    batch = next(iter(pair_stream()))
    assert not same(mirrored(batch), batch)
    assert same(mirrored(mirrored(batch)), batch)


def test_mirrored_motions_compose_to_the_mirrored_trajectory() -> None:
    (episode,) = simulate(WORLD, [7], 120)
    batch = {"relative": relative_poses(episode.poses_xyyaw), "action": torch.from_numpy(episode.actions).long()}
    plain, mirror = se2.r2g(batch["relative"]), se2.r2g(mirrored(batch)["relative"])
    assert torch.allclose(mirror, plain * torch.tensor([1.0, -1.0, -1.0]), atol=1e-4)
    assert plain[:, 1].abs().max() > 0.1  # it does leave the axis
    turned = {Action.FORWARD: 0, Action.TURN_LEFT: 2, Action.TURN_RIGHT: 1}
    assert mirrored(batch)["action"].tolist() == [turned[Action(int(action))] for action in episode.actions]


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


def test_relative_poses_accumulate_to_the_episode() -> None:
    (episode,) = simulate(WORLD, [7], 60)
    poses = torch.from_numpy(episode.poses_xyyaw)
    again = se2.compose(poses[0], se2.r2g(relative_poses(episode.poses_xyyaw).double()))
    assert torch.allclose(again[:, :2], poses[1:, :2], atol=1e-4)


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


def test_revisits_at_any_heading_where_the_world_has_no_limit() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi], [0.0, 0.0, -2.0]])
    assert len(revisits(poses, WORLD, 1)) == 3


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


def test_mazes_without_any_place_seen_twice_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlaceStream, "FRAMES", 60)
    monkeypatch.setattr(PlaceStream, "MIN_STEPS_APART", 55)
    with pytest.raises(
        ValueError,
        match=r"in none of 2 mazes of .* is a place seen twice .*; expected longer episodes or smaller mazes",
    ):
        list(PlaceStream(WORLD, TRAIN_SEEDS, 0, 16, 12))


def test_place_pairs_come_in_either_order() -> None:
    stream = PlaceStream(WORLD, TRAIN_SEEDS, 0, 16, 12)
    episodes = list(simulate(WORLD, stream.groups[0], 400))
    frame = {image.numpy().tobytes(): k for episode in episodes for k, image in enumerate(images_of(WORLD, episode))}
    batch = next(iter(stream))
    order = [
        frame[a.numpy().tobytes()] - frame[b.numpy().tobytes()] for a, b in zip(batch["a"], batch["b"], strict=True)
    ]
    assert min(abs(apart) for apart in order) >= PlaceStream.MIN_STEPS_APART
    assert min(order) < 0 < max(order)


# ---- whole trajectories


def test_each_trajectory_is_met_once_whole_and_every_second_batch_in_a_mirror(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "_GROUP", 4)
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
            assert plain["action"][k].tolist() == episode.actions.tolist()
            again = se2.compose(torch.from_numpy(episode.poses_xyyaw[0]), se2.r2g(plain["relative"][k].double()))
            assert torch.allclose(again[:, :2], torch.from_numpy(episode.poses_xyyaw[1:, :2]), atol=1e-4)


def test_a_batch_that_no_group_holds_is_refused() -> None:
    with pytest.raises(ValueError, match="batch_size is 81; expected 1 to 80"):
        pair_stream(batch_size=81)
    with pytest.raises(ValueError, match="batch_size is 3; expected 1 to 2"):
        TrajectoryStream(WORLD, TRAIN_SEEDS, 0, 4, 3, 60)
