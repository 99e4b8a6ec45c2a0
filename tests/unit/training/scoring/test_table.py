"""The engine of tables: rows x drives x metrics by numbers made by hand, each pair measured once."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from training.scoring import metrics, relations
from training.scoring.statistics import RESAMPLES
from training.scoring.table import (
    Drive,
    Measured,
    Row,
    column,
    folder_digest,
    interval_of,
    intervals,
    means_over_samples,
    measure,
    pairs,
    samples,
)


class Counted:
    """A row whose errors are its number times that of the drive; it knows how often it was asked."""

    def __init__(self, factor: float) -> None:
        self.factor, self.asked = factor, list[float]()

    def __call__(self, made: float) -> Measured:
        self.asked.append(made)
        return Measured({"m": self.factor * made * np.ones(2), "deg": np.array([made])}, {"path": np.arange(3.0)})


def drives(made: list[str] | None = None) -> list[Drive]:
    def make(name: str, value: float) -> float:
        if made is not None:
            made.append(name)
        return value

    return [Drive(name, name, lambda n=name, v=value: make(n, v)) for name, value in (("a", 1.0), ("b", 3.0))]


def test_a_table_is_rows_times_drives_times_metrics(tmp_path: Path) -> None:
    rows = {"one": Row(Counted(1.0)), "ten": Row(Counted(10.0))}
    found = measure([(drive, rows) for drive in drives()], tmp_path)
    assert {drive: list(measured) for drive, measured in found.items()} == {"a": ["one", "ten"], "b": ["one", "ten"]}
    assert means_over_samples(column(found, "ten"))["m"].tolist() == [10.0, 30.0]
    assert samples(column(found, "ten"))["m"].tolist() == [10.0, 10.0, 30.0, 30.0]
    numbers = intervals(means_over_samples(column(found, "one")))
    assert numbers["m"]["mean"] == numbers["deg"]["mean"] == 2.0
    # Of two drives a quarter of the resamples has the smaller one twice: more than the tail of 2.5 %.
    assert numbers["m"]["ci95"] == [1.0, 3.0]


def test_the_interval_is_that_of_a_binomial(tmp_path: Path) -> None:
    values = np.repeat([0.0, 1.0], 50)
    low, high = interval_of(values)["ci95"]
    deviation = 0.5 / np.sqrt(len(values))
    assert interval_of(values)["mean"] == 0.5
    assert [low, high] == pytest.approx([0.5 - 1.96 * deviation, 0.5 + 1.96 * deviation], abs=0.012)
    assert RESAMPLES >= 10_000


def test_what_is_known_is_read_and_no_drive_is_made(tmp_path: Path) -> None:
    made: list[str] = []
    rows = {"one": Row(Counted(1.0)), "ten": Row(Counted(10.0))}
    first = measure([(drive, rows) for drive in drives(made)], tmp_path)
    assert made == ["a", "b"]
    again = measure([(drive, rows) for drive in drives(made)], tmp_path)
    assert made == ["a", "b"]
    for name, measured in first["b"].items():
        np.testing.assert_array_equal(again["b"][name].errors["m"], measured.errors["m"])
        np.testing.assert_array_equal(again["b"][name].drawn["path"], measured.drawn["path"])


def test_a_table_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    def stops(made: float) -> Measured:
        if made == 3.0:
            raise KeyboardInterrupt
        return Measured.of({"m": made})

    with pytest.raises(KeyboardInterrupt):
        measure([(drive, {"one": Row(stops)}) for drive in drives()], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.one.npz"]
    made: list[str] = []
    found = measure([(drive, {"one": Row(Counted(1.0))}) for drive in drives(made)], tmp_path)
    assert made == ["b"] and set(found) == {"a", "b"}


@pytest.mark.parametrize(
    ("drive", "row"),
    [("other", ("", ())), ("a", ("other", ())), ("a", ("", (relations,)))],
    ids=["another drive", "other settings", "other code"],
)
def test_what_follows_from_something_else_is_measured_anew(
    tmp_path: Path, drive: str, row: tuple[str, tuple[ModuleType, ...]]
) -> None:
    counted = Counted(1.0)
    for identity, of_row in (("a", ("", (metrics,))), (drive, row)):
        measure([(Drive("a", identity, lambda: 1.0), {"one": Row(counted, *of_row)})], tmp_path)
    assert counted.asked == [1.0, 1.0]


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut off", b"no archive at all"])
def test_a_damaged_file_is_measured_anew(tmp_path: Path, damage: bytes) -> None:
    counted = Counted(1.0)
    plan = [(drives()[0], {"one": Row(counted)})]
    measure(plan, tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    for content in (damage, whole[: len(whole) // 2], whole[:-10]):
        path.write_bytes(content)
        assert measure(plan, tmp_path)["a"]["one"].errors["m"].tolist() == [1.0, 1.0]
    assert counted.asked == [1.0] * 4


def test_a_measurement_that_fails_leaves_no_file(tmp_path: Path) -> None:
    def fail(_: float) -> Measured:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        measure([(drives()[0], {"one": Row(fail)})], tmp_path)
    assert not list(tmp_path.iterdir())


def test_with_known_rows_alone_nothing_is_measured(tmp_path: Path) -> None:
    counted, other = Counted(1.0), Counted(2.0)
    measure([(drives()[0], {"one": Row(counted)})], tmp_path)
    plan = [(drive, {"one": Row(counted), "two": Row(other)}) for drive in drives()]
    found = measure(plan, tmp_path, known_only=True)
    assert {drive: list(rows) for drive, rows in found.items()} == {"a": ["one"], "b": []}
    assert other.asked == []


def test_rows_are_paired_on_the_drives_where_both_have_a_number() -> None:
    found = {
        "a": {"one": Measured.of({"m": 1.0}), "two": Measured.of({"m": 3.0})},
        "b": {"one": Measured.of({"m": 2.0}), "two": Measured(failed="lost")},
        "c": {"one": Measured.of({"m": 5.0})},
        "d": {"one": Measured.of({"m": 7.0}), "two": Measured.of({"m": 8.0})},
    }
    assert pairs(found, "one", "two", "m").tolist() == [[1.0, 3.0], [7.0, 8.0]]
    assert pairs(found, "one", "three", "m").shape == (0, 2)


def test_a_folder_is_known_by_what_its_files_hold(tmp_path: Path) -> None:
    (tmp_path / "weights").write_text("one")
    before = folder_digest(tmp_path)
    (tmp_path / "below").mkdir()
    assert folder_digest(tmp_path) == before
    (tmp_path / "weights").write_text("two")
    assert folder_digest(tmp_path) != before
