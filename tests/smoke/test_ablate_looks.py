"""The ablation of looks at toy size: four trainings, three tables, and nothing that is made twice."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.smoke import toy
from training import ablate_looks, train_local, train_place
from training.looks import MEASURED_LOOKS
from training.looks_scores import METRICS


def arguments(folder: Path, **changes: Any) -> ablate_looks.Arguments:
    return ablate_looks.Arguments(
        local_epochs=1,
        local_datapoints=1,
        place_epochs=1,
        place_batches=1,
        mazes=2,
        frames=40,
        place_groups=2,
        workers=0,
        out=folder / "results",
        docs=folder / "docs",
        runs=folder / "runs",
        **changes,
    )


def ablate(folder: Path, **changes: Any) -> dict[str, Any]:
    local, place = toy.local("maze3d", folder), toy.place("maze3d", folder)
    return ablate_looks.main(arguments(folder, **changes), local, place)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("looks")
    with pytest.MonkeyPatch.context() as patch:
        toy.shrink(patch, 161, 700)
        yield folder, ablate(folder)


def test_every_network_is_measured_in_every_look(made: tuple[Path, dict[str, Any]]) -> None:
    folder, result = made
    assert json.loads((folder / "results" / "maze3d_looks.json").read_text()) == result
    assert result["command"].startswith("python -m training.ablate_looks --local-epochs 1") and result["revision"]
    assert list(result["tables"]) == list(MEASURED_LOOKS)
    for table in result["tables"].values():
        assert list(table) == list(METRICS)
        for entry in table.values():
            for name in ("plain", "varied"):
                low, high = entry[name]["ci95"]
                assert 0.0 <= low <= entry[name]["mean"] <= high
            assert "difference" in entry["varied_vs_plain"]
    assert list(result["trainings"]) == ["local-plain", "place-plain", "local-varied", "place-varied"]
    for name, training in result["trainings"].items():
        assert f"--looks {name.partition('-')[2]}" in training["command"] and training["seconds"] > 0.0
    assert str(folder) not in json.dumps(result)


def test_networks_of_the_two_looks_differ(made: tuple[Path, dict[str, Any]]) -> None:
    _, result = made
    for table in result["tables"].values():
        assert table["step_m"]["plain"]["mean"] != table["step_m"]["varied"]["mean"]
    plain, held_out = result["tables"]["plain"], result["tables"]["held_out"]
    assert plain["step_m"]["plain"]["mean"] != held_out["step_m"]["plain"]["mean"]


def test_the_page_shows_looks_tables_and_trainings(made: tuple[Path, dict[str, Any]]) -> None:
    folder, result = made
    text = (folder / "docs" / "results_maze3d_looks.md").read_text()
    for name in MEASURED_LOOKS:
        assert text.count(f"## Measured in `{name}`") == 1
    assert text.count("RMSE of a step") == 2 * len(MEASURED_LOOKS) and "2.4 to 3.6" in text
    for training in result["trainings"].values():
        assert training["command"] in text
    assert str(folder) not in text


def test_nothing_is_made_twice_and_other_settings_are_not_mixed_in(
    made: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, result = made
    names = ("training.ablate_looks.local_scores", "training.ablate_looks.place_scores")
    with monkeypatch.context() as patch:
        toy.refuse(patch, (train_local, train_place), *names)
        assert ablate(folder) == result
    with pytest.raises(ValueError, match="holds a run with other arguments: given seed 1; expected seed 0"):
        ablate(folder, seed=1)
