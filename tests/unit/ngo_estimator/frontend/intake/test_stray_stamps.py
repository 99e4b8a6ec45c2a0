"""Stray stamps are left out; sources that restart, or begin late, are not."""

from dataclasses import dataclass

import pytest

from ngo_estimator.frontend.intake.stray_stamps import StrayStamps

S = 10**9
BEGIN = 1_700_000_000 * S


@dataclass(frozen=True)
class Record:
    stamp_ns: int


def run_of(begin_ns: int) -> list[int]:
    return [begin_ns + k * S // 10 for k in range(10)]


@pytest.mark.parametrize(
    ("stamps_ns", "kept_ns"),
    [
        (run_of(BEGIN), run_of(BEGIN)),
        ([0, *run_of(BEGIN)], run_of(BEGIN)),
        ([BEGIN * 2, *run_of(BEGIN)], run_of(BEGIN)),
        ([BEGIN], [BEGIN]),
        ([*run_of(BEGIN), 0], run_of(BEGIN)),
        ([*run_of(BEGIN), 0, *run_of(BEGIN + S)], [*run_of(BEGIN), *run_of(BEGIN + S)]),
        ([*run_of(BEGIN), 0, BEGIN * 3, *run_of(BEGIN + S)], [*run_of(BEGIN), *run_of(BEGIN + S)]),
        ([*run_of(BEGIN), 0, *run_of(BEGIN + 900 * S)], [*run_of(BEGIN), *run_of(BEGIN + 900 * S)]),
        ([*run_of(BEGIN), *run_of(100 * S)], [*run_of(BEGIN), *run_of(100 * S)]),
        ([*run_of(BEGIN), *run_of(BEGIN + 900 * S)], [*run_of(BEGIN), *run_of(BEGIN + 900 * S)]),
    ],
)
def test_only_stamps_that_do_not_go_on_are_left_out(stamps_ns: list[int], kept_ns: list[int]) -> None:
    stray: StrayStamps[Record] = StrayStamps()
    kept = [record.stamp_ns for stamp_ns in stamps_ns for record in stray.add(Record(stamp_ns))]
    kept += [record.stamp_ns for record in stray.flush()]
    assert kept == kept_ns and stray.left_out == len(stamps_ns) - len(kept_ns)
