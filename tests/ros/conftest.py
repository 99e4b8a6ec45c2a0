"""What many tests of nodes take: a probe, and weights of an ngo_node that is fed with relative poses by the test."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from .processes import Probe
from .relative_poses import write_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    write_weights(folder)
    return folder


@pytest.fixture
def probe() -> Iterator[Probe]:
    with Probe() as probe:
        yield probe
