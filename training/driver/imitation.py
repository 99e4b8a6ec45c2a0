"""Imitation of a teacher along the pupil's own way (DAgger).

Ross et al., "A reduction of imitation learning and structured prediction to no-regret online learning" (2011).
The pupil drives a growing share of the way. The teacher says at every decision what it would do, and the pupil learns
from all answers so far. The critic learns from the rewards of the pupil.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, mse_loss

from ngo_sim.distance_driver import DistanceDriver
from training.driver.driving_task import REWARD_PER_M, DrivingTask, Look

_LONGEST_TAUGHT = 4
"""Rounds in which the teacher drives a part of the way: all of it in the first, half as much in each one after."""
_HORIZON = 3.0
"""Rewards of so many times 1 / (1 - discount) decisions make a return; what is cut off before that has none."""


@dataclass(frozen=True)
class Lessons:
    """``rounds`` of ``decisions`` in each task, each followed by ``updates`` of the weights.

    An update is of ``batch_size`` decisions; the learning rate falls along a line.
    """

    rounds: int
    decisions: int
    updates: int
    batch_size: int
    learning_rate: float


class Memory:
    """Pictures, answers of the teacher and later rewards (nan: not known) of each decision."""

    def __init__(self, capacity: int, look: Look) -> None:
        self.pictures = np.zeros((capacity, *look["pictures"].shape), np.uint8)
        self.senses = np.zeros((capacity, *look["senses"].shape), np.float32)
        self.actions = np.zeros(capacity, np.int64)
        self.returns = np.full(capacity, np.nan, np.float32)
        self.count = 0

    def keep(self, looks: Look, actions: np.ndarray) -> None:
        """Add decisions: ``pictures`` and ``senses`` ``(n, ...)``, ``actions`` ``(n,)``."""
        part = slice(self.count, self.count + len(actions))
        self.pictures[part], self.senses[part], self.actions[part] = looks["pictures"], looks["senses"], actions
        self.count = part.stop

    def earned(self, returns: np.ndarray) -> None:
        """Say what came of the latest decisions: ``(n,)``."""
        self.returns[self.count - len(returns) : self.count] = returns

    def batch(self, index: np.ndarray) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Observations, actions and returns of some decisions."""
        seen = {"pictures": torch.from_numpy(self.pictures[index]), "senses": torch.from_numpy(self.senses[index])}
        return seen, torch.from_numpy(self.actions[index]), torch.from_numpy(self.returns[index])


class Lesson:
    """Tasks driven side by side, with a teacher in each."""

    def __init__(self, tasks: Sequence[DrivingTask], rng: np.random.Generator) -> None:
        self.tasks, self.rng = tasks, rng
        begun = [self._begun(task) for task in tasks]
        self.looks, self.poses, self.teachers = (list(column) for column in zip(*begun, strict=True))

    def _begun(self, task: DrivingTask) -> tuple[Look, np.ndarray, DistanceDriver]:
        look, info = task.reset()
        assert task.maze is not None
        return look, info["pose_xyyaw"], DistanceDriver(task.maze, self.rng, task.config.hold_frames, 0.0)

    def drive(
        self, decide: Callable[[Look], np.ndarray], teachers_share: float, decisions: int, memory: Memory
    ) -> tuple[np.ndarray, np.ndarray]:
        """Take decisions in every task and keep what the teachers say.

        Returns the rewards, and whether the episode was over then, both ``(decisions, tasks)``.
        """
        rewards, overs = np.zeros((decisions, len(self.tasks))), np.zeros((decisions, len(self.tasks)), bool)
        for count in range(decisions):
            looks = {name: np.stack([look[name] for look in self.looks]) for name in self.looks[0]}
            said = np.array([int(t.action(pose)) for t, pose in zip(self.teachers, self.poses, strict=True)])
            memory.keep(looks, said)
            taken = np.where(self.rng.random(len(said)) < teachers_share, said, decide(looks))
            for index, (task, action) in enumerate(zip(self.tasks, taken.tolist(), strict=True)):
                self.looks[index], rewards[count, index], _, overs[count, index], info = task.step(action)
                self.poses[index] = info["pose_xyyaw"]
                if overs[count, index]:
                    self.looks[index], self.poses[index], self.teachers[index] = self._begun(task)
        return rewards, overs


def discounted(rewards: np.ndarray, overs: np.ndarray, discount: float) -> np.ndarray:
    """Sums of discounted rewards from each decision on, ``(decisions, tasks)``; nan where too few are known."""
    sums, known = np.zeros(rewards.shape[1]), np.zeros(rewards.shape[1])
    result = np.empty(rewards.shape)
    for count in reversed(range(len(rewards))):
        sums = rewards[count] + discount * np.where(overs[count], 0.0, sums)
        known = 1 + np.where(overs[count], 0, known)
        result[count] = np.where(known >= _HORIZON / (1.0 - discount), sums, np.nan)
    return result


def imitate(
    policy: Any,
    tasks: Sequence[DrivingTask],
    lessons: Lessons,
    discount: float,
    seed: int,
    tell: Callable[[dict[str, float]], None],
) -> None:
    """Teach ``policy`` (of stable-baselines3), its critic too; ``tell`` gets a few figures of each round."""
    lesson, generator = Lesson(tasks, np.random.default_rng((seed, 1))), torch.Generator().manual_seed(seed)
    memory = Memory(lessons.rounds * lessons.decisions * len(tasks), lesson.looks[0])
    optimizer = torch.optim.AdamW(policy.parameters(), lr=lessons.learning_rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, lessons.rounds * lessons.updates)

    @torch.no_grad()
    def decide(looks: Look) -> np.ndarray:
        decided: np.ndarray = policy({name: torch.from_numpy(value) for name, value in looks.items()})[0].numpy()
        return decided

    for count in range(lessons.rounds):
        share = 0.5**count if count < _LONGEST_TAUGHT else 0.0
        policy.set_training_mode(False)
        rewards, overs = lesson.drive(decide, share, lessons.decisions, memory)
        if share == 0.0:  # what is earned by another driver says nothing of this one
            memory.earned(discounted(rewards, overs, discount).ravel())
        policy.set_training_mode(True)
        losses, agreed = [], []
        for _ in range(lessons.updates):
            chosen = torch.randint(memory.count, (lessons.batch_size,), generator=generator).numpy()
            seen, said, returns = memory.batch(chosen)
            features = policy.extract_features(seen)
            logits = policy.action_net(features)
            loss = cross_entropy(logits, said)
            losses.append(loss.item())
            agreed.append((logits.argmax(1) == said).float().mean().item())
            known = ~returns.isnan()
            if known.any():
                loss = loss + 0.5 * mse_loss(policy.value_net(features[known])[:, 0], returns[known])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        frames = rewards.size * tasks[0].config.hold_frames
        tell(
            {
                "teachers_share": share,
                "metres_per_1000_frames": float(1000.0 * rewards.sum() / REWARD_PER_M / frames),
                "loss": float(np.mean(losses)),
                "agreed": float(np.mean(agreed)),
            }
        )
