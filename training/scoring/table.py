"""The engine of every table: rows are measured on drives, each pair once, and what came out is kept on disk.

A table is rows x drives x metrics. A row measures all its metrics on a drive at once. What was measured before is read
while the drive, the row and their code are those of today, so that each command goes on after a stop.
"""

import hashlib
import json
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from tqdm import tqdm

from ngo_common.files import written_whole
from training.common.source_code import code_digest
from training.scoring.statistics import mean_interval

Numbers = dict[str, dict[str, Any]]  # ``{mean, ci95}`` by the metric's key.


@dataclass(frozen=True)
class Measured:
    """What a row gives on a drive.

    ``errors`` by the metric's key, each ``(samples,)``: one a relation, a trajectory or a start, or a single one.
    ``drawn`` are other arrays by name, for pictures and for rows that build on these. ``failed`` says why there is
    nothing.
    """

    errors: dict[str, np.ndarray] = field(default_factory=dict)
    drawn: dict[str, np.ndarray] = field(default_factory=dict)
    failed: str = ""

    @classmethod
    def of(cls, errors: Mapping[str, float], **drawn: np.ndarray) -> "Measured":
        """One number a metric."""
        return cls({key: np.array([value], dtype=np.float64) for key, value in errors.items()}, drawn)


@dataclass(frozen=True)
class Drive:
    """Something to measure on, which is made when a row needs it.

    ``identity`` says in words all that it follows from beside ``code``, the modules that make it.
    """

    name: str
    identity: str
    make: Callable[[], Any]
    code: tuple[ModuleType, ...] = ()


@dataclass(frozen=True)
class Row:
    """One way to measure: ``measure`` gets what a drive makes.

    ``identity`` says in words all that its numbers follow from beside ``code``: weights by their hash, and settings.
    """

    measure: Callable[[Any], Measured]
    identity: str = ""
    code: tuple[ModuleType, ...] = ()


Rows = Mapping[str, Row]
Table = dict[str, dict[str, Measured]]  # By the drive's name, then the row's.


def measure(plan: Sequence[tuple[Drive, Rows]], folder: Path, title: str = "", known_only: bool = False) -> Table:
    """Measure the rows of each drive, or read ``folder/DRIVE.ROW.npz``; with ``known_only`` nothing is measured.

    A bar with the ``title`` shows how far it is; without a title there is none.
    """
    table: Table = {}
    with tqdm(total=sum(len(rows) for _, rows in plan), desc=title, unit="row", disable=not title) as bar:
        for drive, rows in plan:
            table[drive.name] = dict(_measured(drive, rows, folder, known_only, bar))
    return table


def _measured(
    drive: Drive, rows: Rows, folder: Path, known_only: bool, bar: "tqdm[Any]"
) -> Iterator[tuple[str, Measured]]:
    made: list[Any] = []
    for name, row in rows.items():
        bar.set_postfix_str(f"{drive.name} {name}")
        bar.update()
        path = folder / f"{drive.name}.{name}.npz"
        identity = json.dumps([name, row.identity, drive.identity, code_digest((*drive.code, *row.code))])
        known = read(path, identity)
        if known is None and known_only:
            continue
        if known is None:
            made = made or [drive.make()]
            known = row.measure(made[0])
            write(path, identity, known)
        yield name, known


def kept(path: Path, identity: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Arrays that are made once and read then, as measurements are."""
    known = read(path, identity)
    if known is None:
        known = Measured(drawn=make())
        write(path, identity, known)
    return known.drawn


def read(path: Path, identity: str) -> Measured | None:
    """What a file holds, if it is of this identity; None without the file, or where it is damaged."""
    if not path.exists():
        return None
    try:
        with np.load(path) as stored:
            if str(stored["identity"]) != identity:
                return None
            arrays = {name: stored[name] for name in stored.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    parts: dict[str, dict[str, np.ndarray]] = {"error": {}, "drawn": {}}
    for name, array in arrays.items():
        kind, _, key = name.partition(":")
        if key:
            parts[kind][key] = array
    return Measured(parts["error"], parts["drawn"], str(arrays["failed"]))


def write(path: Path, identity: str, measured: Measured) -> None:
    """Keep a measurement: the file is there as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {f"error:{key}": values for key, values in measured.errors.items()}
    arrays |= {f"drawn:{key}": values for key, values in measured.drawn.items()}
    with written_whole(path) as file:
        np.savez(file, identity=np.array(identity), failed=np.array(measured.failed), **arrays)  # type: ignore[arg-type]


def folder_digest(folder: Path) -> str:
    """A hash of the files in a folder of weights and settings, for the identity of what follows from them."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def column(table: Table, row: str) -> list[Measured]:
    """What one row gives on all drives that have it."""
    return [rows[row] for rows in table.values() if row in rows]


def means_over_samples(found: Iterable[Measured]) -> dict[str, np.ndarray]:
    """By the metric's key the mean over the samples of each drive ``(drives,)``, of those that have it."""
    values: dict[str, list[float]] = {}
    for measured in found:
        for key, some in measured.errors.items():
            values.setdefault(key, []).append(float(some.mean()))
    return {key: np.array(means) for key, means in values.items()}


def samples(found: Iterable[Measured]) -> dict[str, np.ndarray]:
    """By the metric's key the samples of all drives one behind the other."""
    values: dict[str, list[np.ndarray]] = {}
    for measured in found:
        for key, some in measured.errors.items():
            values.setdefault(key, []).append(some)
    return {key: np.concatenate(some) for key, some in values.items()}


def pairs(table: Table, row: str, other: str, key: str) -> np.ndarray:
    """The first number of a metric of two rows ``(drives, 2)``, on the drives where both have it."""
    both = [(rows[row].errors, rows[other].errors) for rows in table.values() if row in rows and other in rows]
    found = [(float(a[key][0]), float(b[key][0])) for a, b in both if key in a and key in b]
    return np.array(found).reshape(-1, 2)


def intervals(values: Mapping[str, np.ndarray]) -> Numbers:
    """Mean and bootstrap interval of each metric ``(n,)``; a single number has no interval, and none no mean."""
    return {key: interval_of(some) for key, some in values.items()}


def interval_of(values: np.ndarray) -> dict[str, Any]:
    """``{mean, ci95}`` of ``values`` ``(n,)``."""
    if len(values) == 0:
        return {"mean": None, "ci95": None}
    return mean_interval(values).as_json() if len(values) > 1 else {"mean": float(values[0]), "ci95": None}
