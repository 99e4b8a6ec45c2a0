"""Half the space, the same network."""

import json
from pathlib import Path

import pytest
import torch

from ngo_estimator.checkpoint import LOCAL, OPTIMIZER, PLACE, load_local, load_place, save_checkpoint, write_untrained
from ngo_estimator.online_trajectory import OnlineTrajectory
from training import halve_weights
from training.halve_weights import Arguments


def test_networks_halved_take_half_the_space_and_are_nearly_the_same(tmp_path: Path) -> None:
    write_untrained(tmp_path, "maze2d")
    place, description = load_place(tmp_path)
    optimizer = OnlineTrajectory.load(tmp_path)._optimizer
    details = {"place_encoder_sha256": description["sha256"]}
    save_checkpoint(tmp_path / f"{OPTIMIZER}.safetensors", optimizer, OPTIMIZER, "maze2d", details)
    local = load_local(tmp_path)[0]
    sizes = {kind: (tmp_path / f"{kind}.safetensors").stat().st_size for kind in (LOCAL, PLACE)}
    halve_weights.main(Arguments(tmp_path))
    OnlineTrajectory.load(tmp_path)  # which checks that the optimizer names this place encoder
    for kind, before in ((LOCAL, local), (PLACE, place)):
        path = tmp_path / f"{kind}.safetensors"
        assert path.stat().st_size < 0.55 * sizes[kind]
        assert json.loads(path.with_suffix(".json").read_text())["stored_as"] == "float16"
        after = (load_local if kind == LOCAL else load_place)(tmp_path)[0].state_dict()
        for name, tensor in before.state_dict().items():
            assert after[name].dtype == tensor.dtype
            assert torch.allclose(after[name], tensor, rtol=1e-3, atol=1e-6), name


def test_another_place_encoder_stays_another(tmp_path: Path) -> None:
    write_untrained(tmp_path, "maze2d")
    optimizer = OnlineTrajectory.load(tmp_path)._optimizer
    path = tmp_path / f"{OPTIMIZER}.safetensors"
    save_checkpoint(path, optimizer, OPTIMIZER, "maze2d", {"place_encoder_sha256": "0" * 64})
    halve_weights.main(Arguments(tmp_path, (PLACE,)))
    with pytest.raises(ValueError, match="another place encoder"):
        OnlineTrajectory.load(tmp_path)
