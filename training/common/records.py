"""Where trainings write, and what their results record of how they were made. Without the framework of trainings."""

import dataclasses
import json
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ngo_common.files import write_whole

ROOT = Path(__file__).resolve().parents[2]
WEIGHTS = ROOT / "ros_ws" / "src" / "ngo_estimator" / "weights"


_OWN = ("format", "network", "world", "sha256", "config")


def kept_details(description: dict[str, Any]) -> dict[str, Any]:
    """A description of weights but for what each file has of its own: the details to write other weights with."""
    return {name: value for name, value in description.items() if name not in _OWN}


_WRITTEN = ("docs", "training/results")  # Where tables write: the next cell is measured by the same code.


class RunError(ValueError):
    """The files of a run and its arguments do not fit together; the message is one line with the remedy."""


def revision() -> str:
    """The commit that is checked out, with ``+changes`` where files differ from it that no table writes."""
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True
        ).stdout.strip()
        changes = subprocess.run(
            ["git", "status", "--porcelain", "--untracked-files=no", "--", ".", *(f":!{path}" for path in _WRITTEN)],
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit + ("+changes" if changes.strip() else "")


def check_same_run(folder: Path, now: dict[str, Any], then: dict[str, Any]) -> None:
    """Raise ``RunError`` where the run in a folder was begun with other arguments than those of now."""
    now = json.loads(json.dumps(now))
    if differing := sorted(name for name in now.keys() | then.keys() if now.get(name) != then.get(name)):
        given, expected = (", ".join(f"{name} {of.get(name)}" for name in differing) for of in (now, then))
        raise RunError(
            f"{folder} holds a run with other arguments: given {given}; expected {expected} to go on with it, or the "
            "folder removed to begin anew"
        )


def record(script: str, arguments: Any) -> dict[str, Any]:
    """Command, arguments and revision of a run, for the JSON beside its weights.

    Folders are left out: they say where a network was made, not how; of recordings, the names are kept.
    """
    values, changed = recorded_values(arguments), []
    for field, value in _flat(arguments):
        if field.name in values and value != field.default:
            flag = field.name.replace("_", "-")
            if isinstance(value, bool) and field.default is not None:
                changed.append(f"--{flag}" if value else f"--no-{flag}")
            else:
                kept = values[field.name]
                changed += [f"--{flag}", *map(str, kept if isinstance(kept, tuple) else (kept,))]
    command = shlex.join(["python", "-m", f"training.{script}", *changed])
    return {"command": command, "arguments": values, "revision": revision()}


def recorded_values(arguments: Any) -> dict[str, Any]:
    """Values of arguments by name, of files the names alone, and none of folders."""
    values = {}
    for field, value in _flat(arguments):
        if isinstance(value, tuple) and value and isinstance(value[0], Path):
            values[field.name] = tuple(path.name for path in value)
        elif not isinstance(value, Path):
            values[field.name] = value
    return values


def _flat(arguments: Any) -> Iterator[tuple[dataclasses.Field[Any], Any]]:
    """Fields and their values, those of nested arguments among them where any of these was given."""
    for field in dataclasses.fields(arguments):
        value = getattr(arguments, field.name)
        if not dataclasses.is_dataclass(value):
            yield field, value
        elif field.default_factory is dataclasses.MISSING or value != field.default_factory():
            yield from _flat(value)


def write_at_once(path: Path, text: str) -> None:
    """Write a file so that whoever reads it sees all of it or none, in a folder that is made for it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, text)
