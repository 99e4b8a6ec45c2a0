"""What all commands of the training have in common: their help, and how they end."""

import importlib
import logging
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import tyro

from training import results, train, train_smoother
from training.common.command_line import quiet_framework, run_command
from training.common.records import ROOT, RunError
from training.recordings.recording_source import RecordedArguments

COMMANDS = sorted(
    path.stem
    for path in (ROOT / "training").glob("*.py")
    if "\nif __name__" in path.read_text() and path.stem != "train"
)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_says_first_what_a_command_makes(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    command = importlib.import_module(f"training.{name}")
    assert command.__doc__ is not None
    with pytest.raises(SystemExit, match=r"^0$"):
        tyro.cli(command.Arguments, args=["--help"], description=command.__doc__)
    told = " ".join(capsys.readouterr().out.split())
    first = command.__doc__.splitlines()[0]
    assert first.endswith(".") and first[:40] in told


def test_every_training_is_a_task_of_the_one_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert {f"train_{task}" for task in train.TASKS} == {name for name in COMMANDS if name.startswith("train_")}
    for arguments in ([], ["--help"]):
        train.main(arguments)
        printed = capsys.readouterr().out
        assert all(f"\n  {task:15} {what}\n" in printed for task, what in train.TASKS.items())
    with pytest.raises(SystemExit, match=r"^there is no task 'maps'; expected one of local, place"):
        train.main(["maps"])


def test_a_task_gets_the_flags_behind_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr(train_smoother, "main", given.append)
    train.main(["smoother", "--world", "maze3d", "--memory", "--seed", "7"])
    assert given == [train_smoother.Arguments(world="maze3d", memory=True, seed=7)]


def test_every_table_is_one_of_the_one_command() -> None:
    modules = {path.stem for path in (ROOT / "training").glob("results_*.py")} | {"faults", "relocalisation"}
    assert {*results.TABLES.values()} == modules


@pytest.mark.parametrize("world", ["scan", "map", "faults", "relocalisation"])
def test_a_table_gets_the_flags_beside_its_name(world: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given, table = [], importlib.import_module(f"training.{results.TABLES[world]}")
    monkeypatch.setattr(table, "main", given.append)
    for name in (["--world", world], [f"--world={world}"]):
        results.command_line(["--runs", "here", *name])
    assert given == 2 * [table.Arguments(runs=Path("here"))]


def test_the_one_command_of_tables_names_all_worlds(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        results.command_line(["--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    with pytest.raises(SystemExit) as ended:
        results.command_line(["--world", "mars"])
    for text in (told, str(ended.value)):
        assert f"maze2d, maze3d, {', '.join(results.TABLES)}" in text


def test_a_run_that_does_not_fit_ends_a_command_with_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def main(_: object) -> None:
        raise RunError("the folder holds another run")

    monkeypatch.setattr("sys.argv", ["train_local"])
    with pytest.raises(SystemExit, match=r"^unusable: the folder holds another run$"):
        run_command(main, RecordedArguments, None)


@pytest.fixture
def as_before() -> Iterator[None]:
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        yield
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


@pytest.mark.usefixtures("as_before")
def test_the_framework_is_quiet_and_nothing_else_is() -> None:
    warnings.resetwarnings()
    quiet_framework()
    with warnings.catch_warnings(record=True) as caught:
        warnings.warn_explicit("a hint", UserWarning, "trainer.py", 1, module="lightning.pytorch.trainer")
        warnings.warn_explicit("of weight", UserWarning, "runs.py", 1, module="training.common.runs")
    assert [str(one.message) for one in caught] == ["of weight"]
    assert not logging.getLogger("lightning.pytorch.utilities.rank_zero").isEnabledFor(logging.INFO)
    assert logging.getLogger("lightning.pytorch").isEnabledFor(logging.ERROR)


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="the files are no checkout of git")
@pytest.mark.parametrize(
    ("path", "ignored"),
    [
        ("drive_1.mcap", True),
        ("drive_1.mcap.png", True),
        ("truth.tum", True),
        ("runs/my_robot/features/train/done.json", True),
        ("results/metrics.json", True),
        ("out/plot.png", True),
        ("ros_ws/src/ngo_estimator/weights/my_robot/local_pose_network.json", True),
        ("ros_ws/src/ngo_estimator/weights/maze2d/local_pose_network.json", False),
        ("training/results/maze2d.json", False),
        ("docs/images/demo_maze2d.png", False),
    ],
)
def test_git_ignores_what_the_commands_of_the_docs_leave_behind(path: str, ignored: bool) -> None:
    done = subprocess.run(["git", "check-ignore", "--no-index", "-q", path], cwd=ROOT, check=False)
    assert (done.returncode == 0) == ignored
