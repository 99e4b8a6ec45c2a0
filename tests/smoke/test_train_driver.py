"""The training of the learned driver, in seconds: from nothing to weights that the simulator loads."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ngo_sim.distance_driver import DistanceDriver
from ngo_sim.learned_driver import LearnedDriver
from ngo_sim.maze3d import Maze3D
from ngo_sim.policy_network import PolicyConfig, PolicyView, load_policy
from training.common.records import RunError
from training.data.worlds import TRAIN_SEEDS, world_named
from training.driver.driver_network import Features
from training.driver.driving_task import REWARD_PER_M, DrivingTask
from training.train_driver import Arguments, main


def arguments(folder: Path, **changes: Any) -> Arguments:
    toy: dict[str, Any] = {
        "lessons": 1, "lesson_decisions": 4, "lesson_updates": 2, "decisions": 16, "environments": 2, "steps": 4,
        "batch_size": 8, "episode_frames": 12, "mazes": 2, "checkpoint_decisions": 8,
    }  # fmt: skip
    return Arguments(**{**toy, **changes}, out=folder / "driver.safetensors", runs=folder / "runs")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("driver")
    return folder, main(arguments(folder))


def test_a_training_ends_with_weights_that_drive(trained: tuple[Path, dict[str, Any]]) -> None:
    made, description = trained
    assert json.loads(json.dumps(description)) == json.loads((made / "driver.json").read_text())
    training = description["training"]
    assert training["decisions"] == 16 and training["arguments"]["seed"] == 0
    assert training["command"].startswith("python -m training.train_driver --lessons 1") and training["revision"]
    assert (made / "driver.safetensors").stat().st_size < 300_000
    folder = made / "runs" / "maze3d" / "driver"
    rows = (folder / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["decisions", "8", "16"]
    assert json.loads((folder / "run.json").read_text())["state"] == "complete"

    env = Maze3D()
    driver = LearnedDriver(np.random.default_rng(0), load_policy(made / "driver.safetensors"))
    observation, info = env.reset(seed=TRAIN_SEEDS[0])
    for _ in range(20):
        observation, *_, info = env.step(driver.action(info["pose_xyyaw"], observation))
    env.close()


def test_the_simulators_forward_pass_is_that_of_the_training(trained: tuple[Path, dict[str, Any]]) -> None:
    made, _ = trained
    network, config = load_policy(made / "driver.safetensors"), PolicyConfig()
    state = torch.load(made / "runs" / "maze3d" / "driver" / "last.pt", weights_only=True)["policy"]
    task = DrivingTask(world_named("maze3d"), config, (3,), frames=30, mazes=1)
    features = Features(task.observation_space, config)
    features.load_state_dict({k[19:]: v for k, v in state.items() if k.startswith("features_extractor.")})
    look, _ = task.reset()
    for action in (0, 1, 2, 0):
        look = task.step(action)[0]
        view = PolicyView(config)
        view.pictures, view.senses = look["pictures"], look["senses"]
        batch = {name: torch.from_numpy(values)[None] for name, values in look.items()}
        batch["pictures"] = batch["pictures"] / 255.0
        with torch.no_grad():
            even, odd = features(batch).chunk(2, dim=1)
            forward, turn = (even @ state["action_net.common.weight"].T + state["action_net.common.bias"])[0]
            left = (odd @ state["action_net.turn.weight"].T)[0, 0]
        expected = torch.stack((forward, turn + left, turn - left)).numpy()
        np.testing.assert_allclose(network.logits(view), expected, rtol=1e-3, atol=1e-4)
    task.close()


def test_it_goes_on_where_it_was_stopped_and_not_with_other_arguments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stopped(Exception):
        pass

    def stop(*_: object) -> None:
        raise Stopped

    monkeypatch.setattr("training.train_driver.export", stop)
    with pytest.raises(Stopped):
        main(arguments(tmp_path))
    monkeypatch.undo()
    checkpoint = tmp_path / "runs" / "maze3d" / "driver" / "last.pt"
    state = torch.load(checkpoint, weights_only=True)
    torch.save({**state, "decisions": 8}, checkpoint)
    with pytest.raises(RunError, match="given seed 1; expected seed 0 to go on with it"):
        main(arguments(tmp_path, seed=1))
    main(arguments(tmp_path))
    assert torch.load(checkpoint, weights_only=True)["decisions"] == 16


def test_the_task_pays_the_way_and_is_a_function_of_its_stream() -> None:
    def drive(stream: tuple[int, ...]) -> tuple[list[np.ndarray], float, bool]:
        task = DrivingTask(world_named("maze3d"), PolicyConfig(), stream, frames=30, mazes=2)
        look, info = task.reset()
        begin, seen, paid, over = info["pose_xyyaw"], [look["pictures"]], 0.0, False
        for action in (0, 0, 0, 1, 0, 0, 2, 0, 0, 0):
            assert not over
            look, reward, _, over, info = task.step(action)
            seen.append(look["pictures"])
            paid += reward
        task.close()
        assert paid / REWARD_PER_M >= np.linalg.norm(info["pose_xyyaw"][:2] - begin[:2]) - 1e-9
        return seen, paid, over

    seen, paid, over = drive((1, 2))
    again, _, _ = drive((1, 2))
    other, _, _ = drive((1, 3))
    assert over and paid > 0.0
    np.testing.assert_array_equal(seen, again)
    assert not np.array_equal(seen, other)


@pytest.mark.parametrize("hold_frames", [1, 3])
def test_the_teacher_drives_far_at_any_rate_of_decisions(hold_frames: int) -> None:
    task = DrivingTask(world_named("maze3d"), PolicyConfig(hold_frames=hold_frames), (5,), frames=450, mazes=2)
    paid = 0.0
    for _ in range(2):
        _, info = task.reset()
        assert task.maze is not None
        teacher, over = DistanceDriver(task.maze, np.random.default_rng(0), hold_frames, 0.0), False
        while not over:
            _, reward, _, over, info = task.step(int(teacher.action(info["pose_xyyaw"])))
            paid += reward
        assert len(teacher.goals_reached) >= 3
    task.close()
    assert paid / REWARD_PER_M > 0.22 * 900, "a planner with random goals comes to 0.24 m a frame"


def test_lessons_make_it_drive_as_the_teacher_would(tmp_path: Path) -> None:
    """A few seconds of them: more often than before it decides as the teacher does."""

    def agreement(lessons: int) -> float:
        folder = tmp_path / str(lessons)
        learned: dict[str, Any] = {"lesson_decisions": 200, "lesson_updates": 60, "batch_size": 64}
        main(arguments(folder, decisions=8, mazes=25, lessons=lessons, **learned))
        network, config = load_policy(folder / "driver.safetensors"), PolicyConfig()
        task = DrivingTask(world_named("maze3d"), config, (9,), frames=300, mazes=1)
        look, info = task.reset()
        assert task.maze is not None
        teacher, agreed = DistanceDriver(task.maze, np.random.default_rng(0), config.hold_frames, 0.0), []
        for _ in range(90):
            said = int(teacher.action(info["pose_xyyaw"]))
            view = PolicyView(config)
            view.pictures, view.senses = look["pictures"], look["senses"]
            agreed.append(int(network.logits(view).argmax()) == said)
            look, _, _, _, info = task.step(said)
        task.close()
        return float(np.mean(agreed))

    assert agreement(lessons=2) > agreement(lessons=0) + 0.1
