"""The precision that suits a device, and a run that keeps the one that it began with."""

import json
from pathlib import Path

import pytest
import torch

from tests.unit.training.common.test_runs import Arguments
from training.common import precision, records, runs
from training.common.precision import resolved


@pytest.mark.parametrize(("gain", "expected"), [(0.6, "32-true"), (1.2, "32-true"), (1.3, "bf16-mixed")])
def test_a_cpu_gets_bfloat16_only_where_that_is_clearly_faster(
    gain: float, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precision, "cpu_gain", lambda: gain)
    assert resolved("cpu", "auto", 1) == (expected, f"on this CPU bfloat16 has {gain:.2f} times the speed of float32")


@pytest.mark.parametrize(("supported", "expected"), [(True, "bf16-mixed"), (False, "32-true")])
def test_a_gpu_says_what_it_can(supported: bool, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: supported)
    assert resolved("auto", "auto", 1)[0] == resolved("gpu", "2", 1)[0] == expected


def test_a_run_says_its_precision_once_and_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def begin(wanted: precision.Precision = "auto") -> runs.Run:
        arguments = Arguments("maze2d", accelerator="cpu", precision=wanted)
        return runs.Run(tmp_path, "train_local", arguments, epochs=2)

    monkeypatch.setattr(precision, "cpu_gain", lambda: 0.5)
    run = begin()
    assert run.record["arguments"]["precision"] == "32-true" and run.trainer.precision == "32-true"
    assert "--precision 32-true" in run.record["command"]
    assert capsys.readouterr().out.splitlines() == [
        "precision 32-true: on this CPU bfloat16 has 0.50 times the speed of float32 (--precision chooses another)"
    ]
    run.finish({})
    (tmp_path / "last.ckpt").touch()
    monkeypatch.setattr(precision, "cpu_gain", lambda: 2.0)
    assert begin().record["arguments"]["precision"] == "32-true"
    assert json.loads((tmp_path / "run.json").read_text())["arguments"]["precision"] == "32-true"
    with pytest.raises(records.RunError, match="given precision bf16-mixed; expected precision 32-true"):
        begin("bf16-mixed")
