"""A few seconds of the fuzzer: whatever comes is taken or refused with one clear line. `make fuzz` runs for minutes."""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz import files, nodes
from tests.fuzz.mutants import any_value, mutant
from tests.fuzz.outcomes import Outcomes

pytestmark = pytest.mark.processes

FILES, MESSAGES, SERVICES = 80, 150, 150
TAKES_LONG = {"recordings": 25}


def assert_clean(outcomes: Outcomes, count: int) -> None:
    assert not outcomes.faults, "\n".join(outcomes.faults.values())
    assert outcomes.counts["taken"] + outcomes.counts["clean line"] == count


@pytest.mark.parametrize("name", files.TARGETS)
def test_mutants_of_files(name: str, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    count = TAKES_LONG.get(name, FILES)
    outcomes = files.run(name, count, random.Random(name), tmp_path)
    assert_clean(outcomes, count)
    assert outcomes.counts["clean line"] > 0


@pytest.mark.parametrize("name", nodes.NODES)
def test_messages(name: str) -> None:
    torch.set_num_threads(1)
    outcomes = nodes.run_messages(name, MESSAGES, random.Random(name))
    assert_clean(outcomes, MESSAGES)
    assert outcomes.counts["clean line"] > 0 and outcomes.counts["taken"] > 0


def test_services_in_every_state() -> None:
    torch.set_num_threads(1)
    assert_clean(nodes.run_services(SERVICES, random.Random(0)), SERVICES)


@given(st.binary(min_size=1, max_size=300), st.randoms(use_true_random=False))
def test_mutants_come_from_their_seed(content: bytes, rng: random.Random) -> None:
    state = rng.getstate()
    first = mutant(content, rng)
    rng.setstate(state)
    assert mutant(content, rng) == first


@settings(max_examples=100)
@given(st.randoms(use_true_random=False))
def test_values_fit_their_fields(rng: random.Random) -> None:
    assert -(2**31) <= any_value("int32", rng) < 2**31 and 0 <= any_value("uint8", rng) < 256
    struct.pack("<f", any_value("float", rng))
    assert len(any_value("double[36]", rng)) == 36 and len(any_value("sequence<double, 3>", rng)) <= 3
    any_value("geometry_msgs/PoseWithCovariance", rng)


@pytest.mark.parametrize(
    ("work", "kind"),
    [
        (lambda: None, "taken"),
        (lambda: "a line", "clean line"),
        (lambda: "two\nlines", "traceback"),
        (lambda: int("x"), "clean line"),
        (lambda: {}[1], "traceback"),
    ],
)
def test_outcomes_are_told_apart(work: Callable[[], str | None], kind: str) -> None:
    outcomes = Outcomes()
    outcomes.add("an input", work, (ValueError,))
    assert outcomes.counts == {kind: 1} and len(outcomes.faults) == (kind == "traceback")


def test_a_hang_is_ended_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def endless() -> None:
        while True:
            pass

    monkeypatch.setattr("tests.fuzz.outcomes.LIMIT_S", 0.05)
    outcomes = Outcomes()
    outcomes.add("an input", endless, ())
    assert outcomes.counts == {"hang": 1}
