"""What tells unlike input is fitted, and the table of faults is made, at toy size."""

import json
from pathlib import Path

import pytest
import torch

from ngo_estimator.checkpoint import load_familiarity, write_untrained
from training import faults, train_familiarity


def test_familiarity_is_fitted_and_faults_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)  # some untrained networks know their drives less well than others
    write_untrained(tmp_path / "maze2d", "maze2d")
    train_familiarity.main(
        train_familiarity.Arguments("maze2d", drives=4, limit_drives=2, fault_drives=1, frames=128, weights=tmp_path)
    )
    familiarity = load_familiarity(tmp_path / "maze2d", "maze2d")
    assert familiarity is not None and max(familiarity.config.limits) < 100.0
    # Actions tell turns, whatever the networks learned.
    assert familiarity.config.told_share[2] == 1.0 and familiarity.config.disagreement in train_familiarity.FACTORS
    monkeypatch.setattr(faults, "FAULTS_OF", {"maze2d": ("frozen",)})
    folders = {"weights": tmp_path, "out": tmp_path, "docs": tmp_path, "runs": tmp_path / "runs"}
    arguments = faults.Arguments(split="validation", mazes=2, frames=100, worlds=("maze2d",), **folders)
    result = faults.main(arguments)
    assert json.loads((tmp_path / "faults.json").read_text())["tables"] == result["tables"]
    rows = result["tables"]["maze2d"]
    assert set(rows) == {"clean", "frozen"} and rows["frozen"]["repeated"]["mean"] > 0.5
    # Nobody verifies loops of untrained networks: none closes across what these call unfamiliar.
    assert rows["clean"]["odometry_deviation_growth"]["mean"] < 2.0
    assert "| frozen |" in (tmp_path / "results_faults.md").read_text()
