"""Train the learned driver of the 3D world: a network that drives as far as it can, by PPO.

    python -m training.train_driver

The reward is the distance travelled (paper, section 4.2). The training begins with lessons (DAgger) of a teacher that
knows the maze: without them the driver never found that turning about at the end of a long corridor pays. The weights
go into the package of the simulator, the progress into `metrics.csv` beside `run.json` below `runs/`. Run it again to
continue after the last checkpoint, in mazes that it has not met.
"""

from __future__ import annotations

import csv
import json
import math
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from tqdm import tqdm

from ngo_common.files import written_whole
from ngo_sim.policy_network import SHIPPED, PolicyConfig
from training.common import records
from training.common.command_line import check_at_least, run_command
from training.common.records import write_at_once
from training.data.worlds import World, world_named
from training.driver.driver_network import Features, MirroredPolicy, export
from training.driver.driving_task import REWARD_PER_M, DrivingTask
from training.driver.imitation import Lessons, imitate

CHECKPOINT = "last.pt"


@dataclass(frozen=True)
class Arguments:
    """Settings of a training of the driver."""

    lessons: int = 12  # Rounds of lessons before the reinforcement learning.
    lesson_decisions: int = 500  # Decisions of each environment in a lesson.
    lesson_updates: int = 300  # Updates after a lesson.
    lesson_learning_rate: float = 1e-3  # Learning rate of the first lesson; it falls linearly.
    decisions: int = 500_000
    """Decisions of the reinforcement learning, of all environments together; each holds its action for three frames."""
    environments: int = 16  # Mazes that are driven through side by side.
    steps: int = 128  # Decisions of each environment between two rounds of updates.
    batch_size: int = 256  # Decisions in an update.
    passes: int = 4  # How often a round goes through its decisions.
    episode_frames: int = 600  # Frames in one maze.
    mazes: int = 16  # Mazes of one size that an environment makes at a time.
    learning_rate: float = 3e-4  # Learning rate at the beginning; it falls linearly to zero.
    discount: float = 0.98  # Discount of a reward one decision later.
    entropy: float = 0.005
    """Weight of the entropy of the actions in the loss at the beginning; it falls linearly to zero."""
    checkpoint_decisions: int = 50_000  # Decisions between two checkpoints.
    threads: int = 1  # Threads that the network is trained with.
    seed: int = 0  # Seed of the weights, the mazes and the actions.
    out: Path = SHIPPED  # File that gets the weights; its JSON lies beside it.
    runs: Path = records.ROOT / "runs"  # Folder of checkpoints and logs.

    def __post_init__(self) -> None:
        check_at_least(self, decisions=1, environments=1, steps=1, batch_size=1, passes=1, episode_frames=1, mazes=1)
        check_at_least(self, checkpoint_decisions=1, threads=1, lessons=0, lesson_decisions=1, lesson_updates=1)


class Progress(BaseCallback):
    """Between two updates: lowers the entropy's weight, writes a row of metrics.csv and a checkpoint now and then."""

    def __init__(self, folder: Path, arguments: Arguments, prior_s: float) -> None:
        super().__init__()
        self.folder, self.arguments, self.prior_s = folder, arguments, prior_s
        self.begun_s = time.monotonic()

    def _on_training_start(self) -> None:
        begun, total = self.num_timesteps, self.arguments.decisions
        self.bar = tqdm(total=total, initial=begun, desc="driver", unit="decision")
        self.due = self.num_timesteps + self.arguments.checkpoint_decisions

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        self.bar.update(self.num_timesteps - self.bar.n)
        model.ent_coef = self.arguments.entropy * (1.0 - self.num_timesteps / self.arguments.decisions)
        if self.num_timesteps >= self.due:
            self.due += self.arguments.checkpoint_decisions
            self.keep()

    def _on_training_end(self) -> None:
        self.bar.update(self.num_timesteps - self.bar.n)
        self.bar.close()

    def keep(self) -> None:
        """Write a row and a checkpoint now."""
        values = self.model.logger.name_to_value
        row = {
            "decisions": self.num_timesteps,
            "wall_s": round(self.wall_s, 1),
            "metres_per_1000_frames": round(self.metres_per_1000_frames, 2),
            "entropy": round(-float(values.get("train/entropy_loss", math.nan)), 4),
            "explained_variance": round(float(values.get("train/explained_variance", math.nan)), 4),
        }
        with (self.folder / "metrics.csv").open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
        print(", ".join(f"{name} {value}" for name, value in row.items()), flush=True)
        self.save()

    def save(self) -> None:
        """Write a checkpoint now."""
        state = {
            "decisions": self.num_timesteps,
            "wall_s": self.wall_s,
            "policy": self.model.policy.state_dict(),
            "optimizer": self.model.policy.optimizer.state_dict(),
        }
        with written_whole(self.folder / CHECKPOINT) as file:
            torch.save(state, file)

    @property
    def wall_s(self) -> float:
        """Time that the training has taken, before it was stopped among it."""
        return self.prior_s + time.monotonic() - self.begun_s

    @property
    def metres_per_1000_frames(self) -> float:
        """Of the last 100 mazes; nan before the first."""
        episodes = list(self.model.ep_info_buffer or ())
        frames = PolicyConfig().hold_frames * sum(episode["l"] for episode in episodes)
        return 1000 * sum(episode["r"] for episode in episodes) / REWARD_PER_M / frames if frames else math.nan


def main(arguments: Arguments) -> dict[str, Any]:
    """Train to the last decision, from the last checkpoint; returns the description written beside the weights."""
    torch.set_num_threads(arguments.threads)
    folder = arguments.runs / "maze3d" / "driver"
    record = records.record("train_driver", arguments)
    state = load_state(folder, record)
    done = 0 if state is None else int(state["decisions"])
    write_at_once(folder / "run.json", json.dumps({**record, "state": "running"}, indent=2) + "\n")

    config, world = PolicyConfig(), world_named("maze3d")
    # Begun again, it draws other mazes: how far into a maze it was is not kept.
    streams = [(arguments.seed, index, done) for index in range(arguments.environments)]
    environments = VecMonitor(
        DummyVecEnv(
            [
                partial(DrivingTask, world, config, stream, arguments.episode_frames, arguments.mazes)
                for stream in streams
            ]
        )
    )
    model = make_model(arguments, config, environments)
    if state is not None:
        model.policy.load_state_dict(state["policy"])
        model.policy.optimizer.load_state_dict(state["optimizer"])
        model.num_timesteps = done
    progress = Progress(folder, arguments, 0.0 if state is None else float(state["wall_s"]))
    try:
        if state is None:
            teach(model, arguments, world, config)
            progress.init_callback(model)
            progress.save()
        if done < arguments.decisions:
            model.learn(arguments.decisions - done, progress, log_interval=10**9, reset_num_timesteps=False)
            progress.keep()
    finally:
        environments.close()
    figures = {"decisions": model.num_timesteps, "wall_s": round(progress.wall_s)}
    description = export(arguments.out, model.policy.state_dict(), config, {"training": {**record, **figures}})
    write_at_once(folder / "run.json", json.dumps({**record, **figures, "state": "complete"}, indent=2) + "\n")
    return description


def teach(model: PPO, arguments: Arguments, world: World, config: PolicyConfig) -> None:
    """Give the networks their lessons."""
    if not arguments.lessons:
        return
    lessons = Lessons(
        arguments.lessons,
        arguments.lesson_decisions,
        arguments.lesson_updates,
        arguments.batch_size,
        arguments.lesson_learning_rate,
    )
    # Other mazes than those that it is to train in by itself.
    streams = [(arguments.seed, arguments.environments + index, 0) for index in range(arguments.environments)]
    tasks = [DrivingTask(world, config, stream, arguments.episode_frames, arguments.mazes) for stream in streams]

    def tell(figures: dict[str, float]) -> None:
        print("lesson: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()), flush=True)

    try:
        imitate(model.policy, tasks, lessons, arguments.discount, arguments.seed, tell)
    finally:
        for task in tasks:
            task.close()


def make_model(arguments: Arguments, config: PolicyConfig, environments: VecMonitor) -> PPO:
    """The training, its networks fresh."""
    return PPO(
        MirroredPolicy,
        environments,
        # The last round goes beyond the last decision, and what remains below zero.
        learning_rate=lambda remaining: arguments.learning_rate * max(remaining, 0.0),
        n_steps=arguments.steps,
        batch_size=arguments.batch_size,
        n_epochs=arguments.passes,
        gamma=arguments.discount,
        gae_lambda=0.95,
        ent_coef=arguments.entropy,
        vf_coef=0.5,
        normalize_advantage=True,
        policy_kwargs={
            "features_extractor_class": Features,
            "features_extractor_kwargs": {"config": config},
            "net_arch": [],
        },
        seed=arguments.seed,
        device="cpu",
    )


def load_state(folder: Path, record: dict[str, Any]) -> dict[str, Any] | None:
    """The last checkpoint of a folder, None where there is none; RunError where its run had other arguments."""
    if not (folder / CHECKPOINT).exists():
        return None
    records.check_same_run(folder, record["arguments"], json.loads((folder / "run.json").read_text())["arguments"])
    state: dict[str, Any] = torch.load(folder / CHECKPOINT, weights_only=True)
    return state


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
