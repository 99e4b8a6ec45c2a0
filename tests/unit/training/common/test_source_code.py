"""The key of kept numbers changes with the code that they follow from, and with no other."""

import importlib
import sys
from pathlib import Path

import pytest

from training.common.source_code import code_digest


def test_the_digest_follows_imports_within_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "house_of_tests"
    (package / "deep").mkdir(parents=True)
    sources = {
        "__init__": "",
        "deep/__init__": "",
        "deep/used": "VALUE = 1",
        "between": "import math\nfrom house_of_tests.deep import used",
        "top": "from house_of_tests.between import used",
        "other": "",
    }
    for name, source in sources.items():
        (package / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    top = importlib.import_module(f"{package.name}.top")
    try:
        before = code_digest((top,))
        (package / "other.py").write_text("VALUE = 2")
        code_digest.cache_clear()
        assert code_digest((top,)) == before
        (package / "deep" / "used.py").write_text("VALUE = 2")
        code_digest.cache_clear()
        assert code_digest((top,)) != before
    finally:
        for name in [name for name in sys.modules if name.startswith("house_of_tests")]:
            del sys.modules[name]
