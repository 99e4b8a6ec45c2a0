"""Endless training data: worker processes simulate beside the training, and each datapoint is used once.

An epoch follows from its number alone, through its maze seeds. A resumed training therefore meets the same data as one
that was not stopped.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from ngo_estimator.networks.local_pose_network import NO_ACTION
from training.data import episodes
from training.data.batches import (
    ACTION_HISTORY,
    ALL,
    Batch,
    Share,
    action_histories,
    alike,
    mirrored,
    relative_poses,
)
from training.data.episodes import episodes_in, images_of, wall_ranges
from training.data.worlds import DRAWN, World

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

_FORGOTTEN = 0.1  # share of the pairs in training of whose earlier actions nothing, or not all, is known


class _Stream(IterableDataset[Batch]):
    """The maze seeds of one epoch, dealt out in groups to the processes that train together and to their workers.

    An epoch has as many groups as it takes for all processes to have the same number of them. The world's
    ``training_drivers`` take turns, group by group.
    """

    def __init__(self, world: World, seeds: range, epoch: int, groups: int, frames: int, share: Share = ALL) -> None:
        self.world, self.frames = world, frames
        mazes = -(-groups // share.ranks) * share.ranks * episodes.GROUP
        first = epoch * mazes
        if first + mazes > len(seeds):
            raise ValueError(f"epoch {epoch} asks for more than the {len(seeds)} maze seeds")
        self.first_seed = seeds[0]
        dealt = [list(seeds[i : i + episodes.GROUP]) for i in range(first, first + mazes, episodes.GROUP)]
        self.groups = dealt[share.rank :: share.ranks]

    def __iter__(self) -> Iterator[Batch]:
        worker = get_worker_info()
        mine = self.groups if worker is None else self.groups[worker.id :: worker.num_workers]
        for seeds in mine:
            rng = np.random.default_rng([seeds[0], 1])
            drivers = self.world.stream_drivers
            driver = drivers[(seeds[0] - self.first_seed) // episodes.GROUP % len(drivers)]
            drives = episodes_in(self.world, seeds, seeds, self.frames, DRAWN, driver)
            yield from self.batches(list(drives), rng)

    def __len__(self) -> int:
        return len(self.groups) * self.batches_a_group

    @property
    def batches_a_group(self) -> int:
        """Batches that ``batches`` makes of a group of episodes."""
        raise NotImplementedError

    def batches(self, episodes: list[Episode], rng: np.random.Generator) -> Iterator[Batch]:
        """Batches of one group of episodes."""
        raise NotImplementedError


class PairStream(_Stream):
    """Batches of consecutive frames, shuffled over a group of mazes; every second batch is mirrored.

    What is shuffled are stretches of steps that follow each other, as many as the longest of the world's
    ``error_windows`` has (mostly one). A batch holds ``earlier``, ``later`` ``(batch, height, width, channels)``,
    ``relative`` ``(batch, 3)`` and, in a world with actions, ``action`` ``(batch, ACTION_HISTORY)``: a few of them as
    after a restart, when the earlier ones are not known.
    """

    FRAMES = 401

    def __init__(
        self, world: World, seeds: range, epoch: int, datapoints: int, batch_size: int, share: Share = ALL
    ) -> None:
        self.stretch = self.stretch_of(world)
        pairs = episodes.GROUP * ((self.FRAMES - 1) // self.stretch) * self.stretch
        if not self.stretch <= batch_size <= pairs or batch_size % self.stretch:
            raise ValueError(
                f"batch_size is {batch_size}; expected {self.stretch} to {pairs}, the frame pairs of a group of mazes"
                + (f", in stretches of {self.stretch}" if self.stretch > 1 else "")
            )
        groups = max(1, round(datapoints / (episodes.GROUP * (self.FRAMES - 1))))
        super().__init__(world, seeds, epoch, groups, self.FRAMES, share)
        self.batch_size = batch_size

    @staticmethod
    def stretch_of(world: World) -> int:
        """Steps that stay together."""
        return max(world.error_windows)

    @property
    def batches_a_group(self) -> int:
        return episodes.GROUP * ((self.FRAMES - 1) // self.stretch) // (self.batch_size // self.stretch)

    def batches(self, episodes: list[Episode], rng: np.random.Generator) -> Iterator[Batch]:
        images = torch.stack([images_of(self.world, episode) for episode in episodes])
        relative = torch.stack([relative_poses(episode.poses_xyyaw) for episode in episodes]).flatten(0, 1)
        steps, stretch = self.frames - 1, self.stretch
        whole = torch.arange(len(relative)).unflatten(0, (-1, steps))[:, : steps // stretch * stretch]
        stretches = whole.reshape(-1, stretch)
        order = stretches[torch.from_numpy(rng.permutation(len(stretches)))].flatten()
        if self.world.actions:
            actions = action_histories(np.stack([e.actions for e in episodes])).flatten(0, 1)
            actions[stretches] = partly_forgotten(actions[stretches], rng)
        for count, chosen in enumerate(order.split(self.batch_size)[: self.batches_a_group]):
            episode, step = chosen // steps, chosen % steps
            batch = {
                "earlier": images[episode, step],
                "later": images[episode, step + 1],
                "relative": relative[chosen],
            }
            if self.world.actions:
                batch["action"] = actions[chosen]
            yield mirrored(batch) if count % 2 else batch


def partly_forgotten(actions: Tensor, rng: np.random.Generator) -> Tensor:
    """Histories of actions ``(n, steps, ACTION_HISTORY)`` of stretches, a share of them as after a restart.

    There the first step knows a drawn number of the latest actions alone, and each one after it one more.
    """
    known = rng.integers(1, ACTION_HISTORY, len(actions))
    known[rng.random(len(actions)) >= _FORGOTTEN] = ACTION_HISTORY
    known_then = torch.from_numpy(known).unsqueeze(1) + torch.arange(actions.shape[1])
    age = torch.arange(ACTION_HISTORY - 1, -1, -1)
    return actions.masked_fill(age >= known_then.unsqueeze(-1), NO_ACTION)


class PlaceStream(_Stream):
    """Batches of pairs of frames that show one place, from several mazes and well apart in time.

    A batch holds ``a``, ``b`` ``(batch, height, width, channels)``, their ``poses`` ``(batch, 2, 3)`` and the number of
    their ``maze`` ``(batch,)``; where networks learn to see how far walls are, also the true ``ranges`` ``(batch, 2,
    rays)``. Mazes in which no place is seen twice give none; a group of such mazes alone raises
    ``ValueError``.
    """

    MIN_STEPS_APART = 50
    FRAMES = 1000

    def __init__(
        self, world: World, seeds: range, epoch: int, batches: int, pairs_a_maze: int, share: Share = ALL
    ) -> None:
        super().__init__(world, seeds, epoch, max(1, round(batches / self.batches_a_group)), self.FRAMES, share)
        self.pairs_a_maze = pairs_a_maze

    @property
    def batches_a_group(self) -> int:
        return 16

    def batches(self, episodes: list[Episode], rng: np.random.Generator) -> Iterator[Batch]:
        pairs = [(episode, revisits(episode.poses_xyyaw, self.world, self.MIN_STEPS_APART)) for episode in episodes]
        usable = [(episode, found) for episode, found in pairs if len(found)]
        plan = episodes[0].maze
        if not usable and plan is None:
            return  # a driver that went nowhere on a map
        if not usable:
            assert plan is not None
            raise ValueError(
                f"in none of {len(episodes)} mazes of {plan.walls.shape} blocks is a place seen twice in "
                f"{self.frames} frames, {self.MIN_STEPS_APART} or more apart; expected longer episodes or smaller mazes"
            )
        images = [images_of(self.world, episode) for episode, _ in usable]
        registration = self.world.registration if self.world.sees_ranges else None
        angles = None if registration is None else registration.angles_rad.double().numpy()
        for count in range(self.batches_a_group):
            parts: list[Batch] = []
            for maze, (episode, found) in enumerate(usable):
                chosen = found[rng.choice(len(found), self.pairs_a_maze)]
                swap = rng.random(len(chosen)) < 0.5
                chosen[swap] = chosen[swap, ::-1]
                index = torch.from_numpy(chosen)
                part = {
                    "a": images[maze][index[:, 0]],
                    "b": images[maze][index[:, 1]],
                    "poses": torch.from_numpy(episode.poses_xyyaw[chosen]).float(),
                    # Parts of one drive on a map share its frame.
                    "maze": torch.full((len(chosen),), 0 if episode.maze is None else maze),
                }
                if angles is not None:
                    plan = episode.maze
                    assert plan is not None
                    part["ranges"] = torch.from_numpy(wall_ranges(plan, episode.poses_xyyaw[chosen], angles))
                parts.append(part)
            batch = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
            yield mirrored(batch) if count % 2 else batch


class TrajectoryStream(_Stream):
    """Batches of whole short trajectories, each in a maze of its own; every second batch is mirrored.

    A batch holds ``images`` ``(batch, steps + 1, height, width, channels)``, ``action`` ``(batch, steps,
    ACTION_HISTORY)`` and ``relative`` ``(batch, steps, 3)``.
    """

    def __init__(
        self, world: World, seeds: range, epoch: int, batches: int, batch_size: int, steps: int, share: Share = ALL
    ) -> None:
        if not 1 <= batch_size <= episodes.GROUP:
            raise ValueError(f"batch_size is {batch_size}; expected 1 to {episodes.GROUP}, the mazes of one size")
        self.batch_size = batch_size
        super().__init__(world, seeds, epoch, max(1, round(batches / self.batches_a_group)), steps + 1, share)

    @property
    def batches_a_group(self) -> int:
        return episodes.GROUP // self.batch_size

    def batches(self, episodes: list[Episode], rng: np.random.Generator) -> Iterator[Batch]:
        for count in range(self.batches_a_group):
            chosen = episodes[count * self.batch_size : (count + 1) * self.batch_size]
            batch = {
                "images": torch.stack([images_of(self.world, episode) for episode in chosen]),
                "action": action_histories(np.stack([episode.actions for episode in chosen])),
                "relative": torch.stack([relative_poses(episode.poses_xyyaw) for episode in chosen]),
            }
            yield mirrored(batch) if count % 2 else batch


def revisits(poses_xyyaw: np.ndarray, world: World, min_steps_apart: int) -> np.ndarray:
    """Pairs of frames ``(pairs, 2)``, earlier first, of one place: near in position and heading, well apart in time.

    A frame later than another by ``min_steps_apart`` forms a pair with it within the world's place radius and heading
    limit.
    """
    index = np.arange(len(poses_xyyaw))
    apart = index[None] - index[:, None] >= min_steps_apart
    return np.argwhere(apart & alike(poses_xyyaw, world.place_radius_m, world.heading_limit_rad))


def loader(stream: IterableDataset[Batch], workers: int) -> DataLoader[Batch]:
    """The stream, made by ``workers`` processes beside the training (0: within it)."""
    return DataLoader(stream, batch_size=None, num_workers=workers, prefetch_factor=8 if workers else None)
