"""A command of the training as a user runs it: from any folder, and with nothing printed but its own lines."""

import os
import shlex
import subprocess
from pathlib import Path

import pytest

from training.common.records import ROOT

pytestmark = [pytest.mark.processes, pytest.mark.timeout(180)]


def test_a_training_in_any_folder_prints_its_own_lines_alone(tmp_path: Path) -> None:
    small = "--width 0.03 --epochs 1 --batches 1 --pairs-a-maze 4 --validation-batches 1 --accelerator cpu"
    command = f"python -m training.train_place --world maze2d {small} --out weights --runs runs"
    # A shell that opens the environment and knows nothing else of the project.
    known = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "COLCON_CURRENT_PREFIX")}
    done = subprocess.run(
        ["bash", "-c", f". {shlex.quote(str(ROOT / 'env.sh'))} && {command}"],
        cwd=tmp_path,
        env={**known, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["runs", "weights"]
    lines = [line for line in done.stdout.replace("\r", "\n").replace("\x1b[A", "\n").splitlines() if line.strip()]
    progress = ("Training: ", "Validation: ", "Validation DataLoader", "Epoch ")
    first, last = (line for line in lines if not line.startswith(progress))
    assert first.startswith("precision ") and last.startswith("validation ")
