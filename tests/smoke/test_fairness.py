"""The measurements behind the 3D world's corridor, camera and encoder at toy size."""

import json
from pathlib import Path

import pytest

from ngo_estimator.checkpoint import write_untrained
from tests.smoke import toy
from training import compare_encoders, hard_frames, train_local


def test_hard_frames_are_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_untrained(tmp_path / "weights" / "maze3d", "maze3d")
    result = hard_frames.main(
        hard_frames.Arguments(
            mazes=2,
            frames=40,
            corridors_m=(3.0, 4.0),
            fields_of_view_deg=(90, 108),
            weights=tmp_path / "weights",
            out=tmp_path / "out",
            docs=tmp_path / "docs",
        )
    )
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result
    assert json.loads((tmp_path / "out" / "maze3d_hard_frames.json").read_text()) == result
    worlds = result["worlds"]
    assert isinstance(worlds, list)
    sizes = [(one["corridor_m"], one["field_of_view_deg"]) for one in worlds]
    assert sizes == [(3.0, 90), (3.0, 108), (4.0, 90), (4.0, 108)]
    assert (tmp_path / "docs" / "hard_frames_maze3d.md").exists()
    assert (tmp_path / "docs" / "images" / "hard_frames_maze3d.png").exists()
    assert str(tmp_path) not in json.dumps(result)


def test_encoders_are_trained_and_measured_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    toy.shrink(monkeypatch, 65, 300)
    arguments = compare_encoders.Arguments(
        widths=(0.03,),
        heights=(30, 120),
        minutes=1e-6,
        epochs=1,
        batch_size=32,
        probe_s=0.1,
        mazes=2,
        frames=40,
        validation_mazes=1,
        calibration_mazes=2,
        workers=0,
        runs=tmp_path / "runs",
        out=tmp_path / "out",
        docs=tmp_path / "docs",
    )
    result = compare_encoders.main(arguments)
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result
    assert [(one["height"], one["image_width"]) for one in result["networks"]] == [(30, 40), (120, 160)]
    for one in result["networks"]:
        assert min(one[key] for key in ("pairs_a_second", "inference_ms", "training_minutes", "parameters")) > 0
        assert min(one[key]["mean"] for key in ("rmse_m", "rmse_deg", "final_percent")) > 0
    toy.refuse(monkeypatch, [train_local], "training.compare_encoders.measured")
    again = compare_encoders.main(arguments)
    assert again["networks"] == result["networks"]
