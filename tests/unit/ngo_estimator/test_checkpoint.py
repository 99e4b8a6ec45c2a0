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


def test_an_unknown_world_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="maze2d"):
        write_untrained(tmp_path, "maze4d")


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


def test_buffers_come_from_the_configuration(weights: Path) -> None:
    network, _ = load_local(weights)
    assert network.relative_std.tolist() == pytest.approx(list(network.config.relative_std))


@pytest.mark.parametrize("kind", LOADERS)
@pytest.mark.parametrize("suffix", [".safetensors", ".json"])
def test_a_missing_file_is_named(kind: str, suffix: str, weights: Path) -> None:
    (weights / (kind + suffix)).unlink()
    with pytest.raises(CheckpointError, match="cannot be read") as error:
        LOADERS[kind](weights)
    assert_one_line(error.value, kind + suffix)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError) as error:
        load_local(tmp_path / "nowhere")
    assert_one_line(error.value, "nowhere")


@pytest.mark.parametrize("size", [0, 4, 100, 5000, -1])
def test_a_truncated_file_is_named(size: int, weights: Path) -> None:
    path = weights / f"{PLACE}.safetensors"
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(CheckpointError, match="damaged or no safetensors") as error:
        load_place(weights)
    assert_one_line(error.value, path.name)


def test_a_single_wrong_bit_is_found(weights: Path) -> None:
    path = weights / f"{PLACE}.safetensors"
    content = bytearray(path.read_bytes())
    content[-1000] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="sha256") as error:
        load_place(weights)
    assert_one_line(error.value, path.name)


def test_a_pickle_is_never_opened(weights: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return pytest.fail, ("a pickle was executed",)

    path = weights / f"{LOCAL}.safetensors"
    for content in (pickle.dumps(Trap()), b"PK\x03\x04" + bytes(100)):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="damaged or no safetensors") as error:
            load_local(weights)
        assert_one_line(error.value, path.name)
    torch.save({"trap": Trap()}, path)
    with pytest.raises(CheckpointError, match="damaged or no safetensors"):
        load_local(weights)


def test_weights_of_another_description_are_refused(weights: Path, tmp_path: Path) -> None:
    write_untrained(tmp_path / "other", "maze2d")
    shutil.copy(tmp_path / "other" / f"{LOCAL}.safetensors", weights)
    with pytest.raises(CheckpointError, match="sha256") as error:
        load_local(weights)
    assert_one_line(error.value, f"{LOCAL}.safetensors")


def test_another_world_is_refused(weights: Path) -> None:
    for kind, load in LOADERS.items():
        with pytest.raises(CheckpointError, match="was trained for the world 'maze2d'; expected 'maze3d'") as error:
            load(weights, "maze3d")
        assert_one_line(error.value, f"{kind}.json")


def test_another_network_is_refused(weights: Path) -> None:
    for suffix in (".safetensors", ".json"):
        shutil.copy(weights / (PLACE + suffix), weights / (LOCAL + suffix))
    with pytest.raises(CheckpointError, match=f"describes a '{PLACE}'; expected a '{LOCAL}'") as error:
        load_local(weights)
    assert_one_line(error.value, f"{LOCAL}.json")


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"null", b"\xff\xfe\x00", b'{"format": 99}', b"\x00" * 50, b"[" * 10**6]
)
def test_a_description_that_is_none_is_refused(content: bytes, weights: Path) -> None:
    (weights / f"{LOCAL}.json").write_bytes(content)
    with pytest.raises(CheckpointError) as error:
        load_local(weights)
    assert_one_line(error.value, f"{LOCAL}.json")


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
def test_a_pipe_is_refused_and_not_waited_for(suffix: str, weights: Path) -> None:
    path = (weights / LOCAL).with_suffix(suffix)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match=r"cannot be read \(it is no regular file\)") as error:
        load_local(weights)
    assert_one_line(error.value, path.name)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("widht",), 0.5, "unknown keys"),
        (("image", "depth"), 8, "unknown keys"),
        (("width",), None, "missing"),  # None: the key is taken away
        (("image", "height"), None, "missing"),
        (("width",), "wide", "width"),
        (("width",), 9.0, "width is 9.0"),
        (("width",), True, "width"),
        (("hidden_size",), 2.5, "hidden_size"),
        (("hidden_size",), "256", "hidden_size"),
        (("hidden_size",), 10**15, "1000000000000000 is given where an integer up to 1000000 is expected"),
        (("hidden_size",), 10**30, "is given where an integer up to 1000000 is expected"),
        (("relative_std",), 5.0, "relative_std"),
        (("relative_std",), [1.0, 1.0], "relative_std"),
        (("relative_std",), ["a", 1.0, 1.0], "relative_std"),
        (("relative_std",), [float("nan"), 1.0, 1.0], "relative_std"),
        (("relative_std",), [0.0, 1.0, 1.0], "relative_std"),
        (("image",), 7, "ImageFormat is 7; expected an object"),
        (("image", "dtype"), "float16", "channels"),
        (("image", "field_of_view_deg"), 90.0, "a scan is"),
        (("image", "field_of_view_deg"), "wide", "'wide' is given where float is expected"),
        (("twist_scale",), [1.0, 0.0, 1.0], "twist_scale"),
    ],
)
def test_a_wrong_configuration_is_refused(where: tuple[str, ...], value: object, message: str, weights: Path) -> None:
    def change(description: dict[str, Any]) -> None:
        section = description["config"]
        for name in where[:-1]:
            section = section[name]
        if value is None:
            # width and height have no default; a key with one may be left out.
            del section[where[-1]]
        else:
            section[where[-1]] = value

    edit(weights / f"{LOCAL}.json", change)
    with pytest.raises(CheckpointError, match=message) as error:
        load_local(weights)
    assert_one_line(error.value, f"{LOCAL}.json")


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


def test_a_configuration_that_is_missing_is_refused(weights: Path) -> None:
    edit(weights / f"{OPTIMIZER}.json", lambda description: description.pop("config"))
    with pytest.raises(CheckpointError, match="expected an object") as error:
        load_optimizer(weights)
    assert_one_line(error.value, f"{OPTIMIZER}.json")


@pytest.mark.parametrize("dilations", [[1.5], "1", [[1]], [1, 0], []])
def test_wrong_dilations_are_refused(dilations: object, weights: Path) -> None:
    edit(weights / f"{OPTIMIZER}.json", lambda description: description["config"].update(dilations=dilations))
    with pytest.raises(CheckpointError, match="dilations") as error:
        load_optimizer(weights)
    assert_one_line(error.value, f"{OPTIMIZER}.json")


@pytest.mark.parametrize("change", [{"feature_size": 32}, {"width": 0.25}, {"actions": 0}])
def test_tensors_that_do_not_fit_are_refused(change: dict[str, object], weights: Path) -> None:
    edit(weights / f"{LOCAL}.json", lambda description: description["config"].update(change))
    with pytest.raises(CheckpointError, match="does not fit its configuration") as error:
        load_local(weights)
    assert_one_line(error.value, f"{LOCAL}.safetensors")


def test_another_image_size_is_refused(weights: Path) -> None:
    edit(weights / f"{LOCAL}.json", lambda description: description["config"]["image"].update(width=500))
    with pytest.raises(CheckpointError, match="does not fit its configuration") as error:
        load_local(weights)
    assert_one_line(error.value, f"{LOCAL}.safetensors")


def test_weights_that_are_not_finite_are_refused(weights: Path) -> None:
    network, _ = load_local(weights)
    with torch.no_grad():
        network.hidden.weight[0, 0] = torch.nan
    save_checkpoint(weights / f"{LOCAL}.safetensors", network, LOCAL, "maze2d", {})
    with pytest.raises(CheckpointError, match=r"not finite in hidden\.weight") as error:
        load_local(weights)
    assert_one_line(error.value, f"{LOCAL}.safetensors")


def test_the_paper_form_round_trips(tmp_path: Path) -> None:
    from tests.unit.ngo_estimator.samples import small_optimizer

    optimizer = small_optimizer("paper", trained=True)
    save_checkpoint(tmp_path / f"{OPTIMIZER}.safetensors", optimizer, OPTIMIZER, "maze3d", {})
    assert load_optimizer(tmp_path)[0].config == optimizer.config
