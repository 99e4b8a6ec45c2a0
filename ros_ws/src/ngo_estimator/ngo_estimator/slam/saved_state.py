"""The file format of a saved state: one folder with the arrays in safetensors, and a description in JSON.

``state.json`` names the file of the arrays and its hash, and is put in place last: until then an older state in the
folder stays whole.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ngo_common.files import PARTIAL, sync_names, write_whole
from ngo_estimator.data.state_arrays import Arrays, StateError

FORMAT = 10
DESCRIPTION = "state.json"
_KEYS = {"format", "identity", "arrays", "arrays_sha256", "sha256"}


def write_state(folder: Path, identity: Mapping[str, Any], arrays: Arrays) -> None:
    """Write ``arrays`` of a trajectory with this ``identity``, all at once or not at all.

    The folder is made where there is none; its parent must exist. A state in it is replaced if it is of this kind:
    that of ``ngo_node`` and the scans of ``ngo_map`` need a folder each.

    Raises:
        StateError: the folder holds other files or a state of the other kind, or cannot be written; or safetensors is
            not installed.
    """
    # It writes the memory as it is.
    content = _safetensors().numpy.save({name: np.require(array, requirements="C") for name, array in arrays.items()})
    digest = hashlib.sha256(content).hexdigest()
    name = f"arrays-{digest[:16]}.safetensors"
    description = {"format": FORMAT, "identity": dict(identity), "arrays": name, "arrays_sha256": digest}
    try:
        made = not folder.exists()
        old = set() if made else _files_of_a_state(folder)
        if DESCRIPTION in old:
            _refuse_the_other_kind(folder, identity)
        folder.mkdir(exist_ok=True)
        try:
            if name not in old:
                write_whole(folder / name, content)
            write_whole(folder / DESCRIPTION, _text(description))
        except OSError:
            if name not in old:
                (folder / name).unlink(missing_ok=True)
            if made:
                folder.rmdir()
            raise
        for leftover in old - {name, DESCRIPTION}:
            (folder / leftover).unlink(missing_ok=True)
        sync_names(folder.parent)
    except OSError as error:
        raise StateError(f"{error.filename or folder}: cannot be written ({error.strerror})") from error


def identity_of(folder: Path) -> dict[str, Any]:
    """Whose state is in ``folder``, as ``read_state`` expects it; raises ``StateError``, of one line."""
    identity: dict[str, Any] = _description(folder / DESCRIPTION)["identity"]
    return identity


def read_state(folder: Path, identity: Mapping[str, Any]) -> Arrays:
    """The arrays in ``folder``, which were saved by a trajectory with this ``identity``.

    Raises:
        StateError: of one line, about what is missing, damaged, or other than here.
    """
    path = folder / DESCRIPTION
    description = _description(path)
    saved, here = description["identity"], json.loads(json.dumps(identity))
    if _kind(saved) != _kind(here):
        raise StateError(f"{path}: is {_kind(saved)}; expected {_kind(here)}")
    for key in {**here, **saved}:
        if saved.get(key) != here.get(key):
            raise StateError(f"{path}: was saved with {_difference(key, saved.get(key), here.get(key))}")
    arrays = folder / Path(description["arrays"]).name
    content = _read(arrays)
    if hashlib.sha256(content).hexdigest() != description["arrays_sha256"]:
        raise StateError(f"{arrays}: is damaged (its sha256 is not the one in {DESCRIPTION})")
    library = _safetensors()
    try:
        return dict(library.numpy.load(content))
    except library.SafetensorError as error:
        raise StateError(f"{arrays}: is no safetensors file ({error})") from error


def _safetensors() -> Any:
    """The library; a node that saves and loads nothing does without it."""
    try:
        import safetensors.numpy
    except ImportError as error:
        raise StateError("saved states need the Python package safetensors, which is not installed") from error
    return safetensors


def _kind(identity: Mapping[str, Any]) -> str:
    return "the scans of an ngo_map" if "map" in identity else "the state of an ngo_node"


def _refuse_the_other_kind(folder: Path, identity: Mapping[str, Any]) -> None:
    try:
        there = _description(folder / DESCRIPTION)["identity"]
    except StateError:  # it is damaged, or of another format: nothing is lost
        return
    if _kind(there) != _kind(identity):
        raise StateError(f"{folder}: holds {_kind(there)}; save {_kind(identity)} in a folder of its own")


def _files_of_a_state(folder: Path) -> set[str]:
    """Names of what is in the folder; raises ``StateError`` where something is no part of a state."""
    if not folder.is_dir():
        raise StateError(f"{folder}: is a file; expected a folder, or nothing")
    names = {path.name for path in folder.iterdir()}
    for name in sorted(names):
        if name.endswith(PARTIAL):  # of a crash
            whole = name.removeprefix(".").removesuffix(PARTIAL).rpartition(".")[0]
        else:
            whole = name
        if whole != DESCRIPTION and not (whole.startswith("arrays-") and whole.endswith(".safetensors")):
            raise StateError(f"{folder}: holds '{name}'; expected a saved state, an empty folder or none")
    return names


def _text(description: Mapping[str, Any]) -> str:
    """The JSON of a description, with its own hash."""
    digest = hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()
    return json.dumps({**description, "sha256": digest}, indent=2) + "\n"


def _description(path: Path) -> dict[str, Any]:
    content = _read(path)
    try:
        text = content.decode()
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise StateError(f"{path}: is damaged, or no JSON ({error})") from error
    if not isinstance(values, dict) or "format" not in values:
        raise StateError(f"{path}: is not the description of a saved state")
    if values["format"] != FORMAT:
        raise StateError(f"{path}: is of format {values['format']!r}; expected {FORMAT}")
    if set(values) != _KEYS or _text({k: v for k, v in values.items() if k != "sha256"}) != text:
        raise StateError(f"{path}: is damaged (it is not what its sha256 says)")
    return values


def _difference(key: str, saved: Any, here: Any) -> str:
    """The first difference of two values, which may be nested."""
    if isinstance(saved, dict) and isinstance(here, dict):
        for inner in sorted({*saved, *here}):
            if inner not in saved:
                return f"another version: the setting {key}.{inner} is new here"
            if saved[inner] != here.get(inner):
                return _difference(f"{key}.{inner}", saved[inner], here.get(inner))
    return f"{key} {json.dumps(saved)}; here it is {json.dumps(here)}"


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise StateError(f"{path}: cannot be read ({error.strerror})") from error
