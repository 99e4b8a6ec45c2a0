"""What several tests of the training begin with."""

from pathlib import Path

import pytest

from .stores import write_store


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A small store of features."""
    write_store(tmp_path)
    return tmp_path
