"""The source code that a number follows from, as a key for what is kept on disk."""

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

_READS = ("ngo_estimator.checkpoint",)
"""Modules that import every network to read the one that is asked for: what reads one imports its network, too."""


@cache
def code_digest(modules: tuple[ModuleType, ...]) -> str:
    """A hash of the modules and of all that they import from their own top-level package, directly or not.

    The files are read once in a process, as modules are.
    """
    files = {name: path for module in modules for name, path in _files(module.__name__)}
    return hashlib.sha256(b"".join(files[name].read_bytes() for name in sorted(files))).hexdigest()


def _files(module: str) -> Iterator[tuple[str, Path]]:
    """The files, each with its path below the folder of the package: wherever that lies, the order is the same."""
    package = module.partition(".")[0]
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"{module} is in no package; expected a module of one")
    folder = Path(spec.submodule_search_locations[0]).parent
    todo, seen = [module], {module}
    while todo:
        path = folder / todo.pop().replace(".", "/")
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if not path.is_file():  # a name within a module
            continue
        yield str(path.relative_to(folder)), path
        names = {name for name in _imported(path.read_bytes()) if name.partition(".")[0] == package}
        todo += sorted(names - seen - {*_READS})
        seen |= names


def _imported(source: bytes) -> Iterator[str]:
    """Dotted names: ``from a import b`` gives ``a`` and ``a.b``, for ``b`` may be a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
