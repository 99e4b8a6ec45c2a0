"""The evaluation of the scan model: its rows are what they say, and its table is what it prints."""

import json
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.checkpoint import WORLD_IMAGES, write_untrained
from training import evaluate_scan


def test_a_row_changes_the_scanner_and_nothing_else() -> None:
    (plain,) = evaluate_scan.episodes("noise 0 cm", 1, 30)
    (noisy,) = evaluate_scan.episodes("noise 5 cm", 1, 30)
    np.testing.assert_array_equal(plain.poses_xyyaw, noisy.poses_xyyaw)
    both = np.isfinite(plain.observations) & np.isfinite(noisy.observations)
    assert 0.02 < (noisy.observations - plain.observations)[both].std() < 0.06


def test_the_simulators_own_scanner_sees_its_depths() -> None:
    (episode,) = evaluate_scan.episodes(evaluate_scan.OWN_SCANNER, 1, 5)
    assert episode.observations.shape == (5, 289)
    assert np.isinf(episode.observations).sum(1).tolist() == [48] * 5  # 60 degrees at the back, a ray each 1.25
    for scan in episode.observations:
        WORLD_IMAGES["scan"].check(scan.reshape(1, -1, 1))


def test_the_table_is_the_last_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_untrained(tmp_path / "scan", "scan")
    rows = ("noise 5 cm, dropouts 20 %", "maze2d")
    table = evaluate_scan.main(evaluate_scan.Arguments(trajectories=1, frames=40, rows=rows, weights=tmp_path))
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == table
    assert tuple(table) == rows
    for row in table.values():
        assert row["path_m"] > 0.0 and row["odometry"]["position_rmse_m"] > 0.0
        assert np.isfinite(list(row["corrected"].values())).all()
    with pytest.raises(ValueError, match="rows has noise 9 cm; expected among as drawn in training, noise 0 cm"):
        evaluate_scan.Arguments(rows=("noise 9 cm",))
