"""Checkpoints: bitwise round trips, and one clear line for every way in which they can be wrong."""

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ngo_estimator import checkpoint
from ngo_estimator.checkpoint import (
    LOCAL,
    OPTIMIZER,
    PLACE,
    load_local,
    load_optimizer,
    load_place,
    save_checkpoint,
    write_untrained,
)
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.weights_file import CheckpointError

LOADERS: dict[str, Callable[..., Any]] = {LOCAL: load_local, PLACE: load_place, OPTIMIZER: load_optimizer}


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("untrained")
    write_untrained(folder, "maze2d")
    return folder


@pytest.fixture
def weights(untrained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(untrained, tmp_path / "weights"))


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    description = json.loads(path.read_text())
    change(description)
    path.write_text(json.dumps(description))


def assert_one_line(error: BaseException, name: str) -> None:
    assert isinstance(error, ValueError)
    assert "\n" not in str(error)
    assert name in str(error)


@pytest.mark.parametrize("world", ["maze2d", "maze3d"])
def test_untrained_networks_load_for_their_world(world: str, tmp_path: Path) -> None:
    write_untrained(tmp_path, world)
    for load in LOADERS.values():
        network, description = load(tmp_path, world)
        assert description["world"] == world
        assert not network.training and not any(p.requires_grad for p in network.parameters())
    assert load_local(tmp_path)[0].config.image == checkpoint.WORLD_IMAGES[world]
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.parametrize(
    "image",
    [
        ImageFormat(48, 64, 1, "uint8"),
        ImageFormat(48, 64, 1, "float32", depth_gain_m=4.0, depth_softening_m=2.0),
        ImageFormat(1, 90, 1, "float32", field_of_view_deg=270.0),
    ],
    ids=["grey", "depth", "scan"],
)
def test_a_world_of_ones_own_may_have_any_sensor(image: ImageFormat, tmp_path: Path) -> None:
    write_untrained(tmp_path, "our_robot", image)
    for load in (load_local, load_place):
        network, description = load(tmp_path, "our_robot")
        assert network.config.image == image and description["world"] == "our_robot"
    with pytest.raises(CheckpointError, match="for the world 'our_robot'; expected 'maze2d'"):
        load_local(tmp_path, "maze2d")


@pytest.mark.parametrize("kind", LOADERS)
def test_round_trip_is_bitwise(kind: str, weights: Path, tmp_path: Path) -> None:
    network, description = LOADERS[kind](weights)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(torch.randn_like(parameter))
    save_checkpoint(tmp_path / f"{kind}.safetensors", network, kind, "maze2d", {"metrics": {"rmse": 0.5}})
    again, details = LOADERS[kind](tmp_path, "maze2d")
    assert again.config == network.config
    assert details["metrics"] == {"rmse": 0.5}
    state, expected = again.state_dict(), network.state_dict()
    assert state.keys() == expected.keys()
    assert all(torch.equal(state[name], expected[name]) for name in state)
    first = (tmp_path / f"{kind}.safetensors").read_bytes()
    save_checkpoint(tmp_path / f"{kind}.safetensors", again, kind, "maze2d", {})
    assert (tmp_path / f"{kind}.safetensors").read_bytes() == first
    assert description["network"] == kind


class Trap:
    def __reduce__(self) -> tuple[Any, ...]:
        return pytest.fail, ("a pickle was executed",)


def cut(size: int) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(path.read_bytes()[:size])


def one_wrong_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1000] ^= 1
    path.write_bytes(content)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def of_another_network(path: Path) -> None:
    for suffix in (".safetensors", ".json"):
        shutil.copy((path.parent / PLACE).with_suffix(suffix), path.with_suffix(suffix))


def not_finite(path: Path) -> None:
    network, _ = load_local(path.parent)
    with torch.no_grad():
        network.hidden.weight[0, 0] = torch.nan
    save_checkpoint(path, network, LOCAL, "maze2d", {})


@pytest.mark.parametrize(
    ("suffix", "damage", "complaint"),
    [
        *((suffix, Path.unlink, "cannot be read") for suffix in ("safetensors", "json")),
        *((suffix, pipe, r"cannot be read \(it is no regular file\)") for suffix in ("safetensors", "json")),
        *(("safetensors", cut(size), "damaged or no safetensors") for size in (0, 100, -1)),
        ("safetensors", one_wrong_bit, "sha256"),
        ("safetensors", lambda path: path.write_bytes(pickle.dumps(Trap())), "damaged or no safetensors"),
        ("safetensors", lambda path: torch.save({"trap": Trap()}, path), "damaged or no safetensors"),
        ("safetensors", not_finite, r"not finite in hidden\.weight"),
        ("json", of_another_network, f"describes a '{PLACE}'; expected a '{LOCAL}'"),
        *(
            ("json", lambda path, content=content: path.write_bytes(content), None)
            for content in (b"", b"{", b"[]", b"null", b"\xff\xfe\x00", b'{"format": 99}', b"[" * 10**6)
        ),
    ],
)
def test_every_damage_of_weights_and_of_their_description_is_one_line(
    suffix: str, damage: Callable[[Path], object], complaint: str | None, weights: Path
) -> None:
    path = weights / f"{LOCAL}.{suffix}"
    damage(path)
    with pytest.raises(CheckpointError, match=complaint) as error:
        load_local(weights)
    assert_one_line(error.value, path.name)


def test_another_world_is_refused(weights: Path) -> None:
    for kind, load in LOADERS.items():
        with pytest.raises(CheckpointError, match="was trained for the world 'maze2d'; expected 'maze3d'") as error:
            load(weights, "maze3d")
        assert_one_line(error.value, f"{kind}.json")


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"widht": 0.5}, "unknown keys"),
        ({"image": {}}, "missing"),
        ({"image": 7}, "ImageFormat is 7; expected an object"),
        ({"width": 9.0}, "width is 9.0"),
        ({"width": True}, "width"),
        ({"hidden_size": "256"}, "hidden_size"),
        ({"hidden_size": 10**15}, "1000000000000000 is given where an integer up to 1000000 is expected"),
        ({"relative_std": [1.0, 1.0]}, "relative_std"),
        ({"relative_std": [0.0, 1.0, 1.0]}, "relative_std"),
        ({"feature_size": 32}, "does not fit its configuration"),
    ],
)
def test_a_wrong_configuration_is_refused(changes: dict[str, Any], complaint: str, weights: Path) -> None:
    edit(weights / f"{LOCAL}.json", lambda description: description["config"].update(changes))
    with pytest.raises(CheckpointError, match=complaint) as error:
        load_local(weights)
    assert_one_line(error.value, LOCAL)


def test_a_description_with_settings_that_went_loads(weights: Path) -> None:
    beside = weights / f"{OPTIMIZER}.json"
    expected = load_optimizer(weights)[0]
    edit(beside, lambda description: description["config"].update(compass=False))
    assert load_optimizer(weights)[0].config == expected.config
    edit(beside, lambda description: description["config"]["search"].update(witnesses=0))
    load_optimizer(weights)
    edit(beside, lambda description: description["config"].update(compass=True))
    with pytest.raises(CheckpointError, match="compass is True, which this version no longer has") as error:
        load_optimizer(weights)
    assert_one_line(error.value, beside.name)


def test_the_paper_form_round_trips(tmp_path: Path) -> None:
    from tests.unit.ngo_estimator.samples import small_optimizer

    optimizer = small_optimizer("paper", trained=True)
    save_checkpoint(tmp_path / f"{OPTIMIZER}.safetensors", optimizer, OPTIMIZER, "maze3d", {})
    assert load_optimizer(tmp_path)[0].config == optimizer.config
