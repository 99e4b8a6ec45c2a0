"""The folders that every command of a table takes, and what it writes there."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from training.common import records
from training.common.records import write_at_once


@dataclass(frozen=True, kw_only=True)
class Folders:
    """Where a table finds what it needs, and where it writes."""

    weights: Path = records.WEIGHTS  # Folder with WORLD/*.safetensors.
    out: Path = records.ROOT / "training" / "results"  # Folder that gets the JSON, and holds WORLD.gtsam.json.
    docs: Path = records.ROOT / "docs"  # Folder that gets the page, and its figures in images/.
    runs: Path = records.ROOT / "runs"  # Folder of drives and of what was measured.

    @property
    def images(self) -> Path:
        """Folder of the figures."""
        return self.docs / "images"

    def made(self, world: str) -> dict[str, str]:
        """How a table comes about: the ``command``, FOLDER for folders of data that are given, and the ``revision``."""
        record = records.record("results", self)
        data = [field.name for field in fields(self) if field.default is None]
        given = [name for name in data if getattr(self, name) is not None]
        flags = [*record["command"].split()[3:], *(f"--{name} FOLDER" for name in given)]
        chosen = f' ARGS="{" ".join(flags)}"' if flags else ""
        return {"command": f"make results WORLD={world}{chosen}", "revision": record["revision"]}

    def published(self, name: str) -> dict[str, Any]:
        """The content of ``NAME.json``; empty where there is none."""
        path = self.out / f"{name}.json"
        return json.loads(path.read_text()) if path.is_file() else {}

    def publish(self, name: str, result: dict[str, Any], page: str) -> dict[str, Any]:
        """Write ``NAME.json`` and ``results_NAME.md``; returns the content of the JSON."""
        write_at_once(self.out / f"{name}.json", json.dumps(result, indent=2) + "\n")
        write_at_once(self.docs / f"results_{name}.md", page)
        return result


def with_earlier(cells: Mapping[str, Any], published: Mapping[str, Any], revision: str) -> dict[str, Any]:
    """``cells`` by name, and those that are ``published`` and not measured anew, which name their ``revision``."""
    return {name: {"revision": revision, **cell} for name, cell in published.items()} | dict(cells)
