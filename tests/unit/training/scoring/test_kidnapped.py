"""Scores of kidnapped starts, computed by hand."""

import math

import numpy as np
import pytest

from training.scoring.kidnapped import FRAMES, KnownMap, MapErrors, scored, starts
from training.scoring.kidnapped_logs import LogStart, as_arrays, starts_of, summary_of

TRUTH = np.stack((np.arange(200) * 0.1, np.zeros(200), np.zeros(200)), axis=-1)


def known(bent_m: float = 0.0) -> KnownMap:
    """The map of the first 10 m, whose second half lies ``bent_m`` aside."""
    poses = TRUTH[:100].copy()
    poses[50:, 1] += bent_m
    return KnownMap(poses, TRUTH[:100], np.zeros((100, 1)), 0.5)


def test_a_pose_is_measured_where_the_map_has_the_robot() -> None:
    errors = MapErrors(known(0.8), TRUTH)
    assert errors.of(80, np.array((8.0, 0.8, 0.0))) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert errors.of(80, np.array((8.3, 0.8, math.radians(2.0)))) == pytest.approx((0.3, 2.0))
    # As seen from the map's first frame, the truth is right as well.
    assert errors.of(80, np.array((8.0, 0.0, 0.0))) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert errors.of(80, np.array((8.0, -0.6, 0.0)))[0] == pytest.approx(0.6)


def test_starts_lie_where_the_map_shows_the_way_and_others_where_it_does_not() -> None:
    mapped, others = starts(MapErrors(known(), TRUTH), 200, 5)
    assert len(mapped) == 5 and len(others) == 1
    # 46 of 51 frames within 1 m of the map, which ends at 9.9 m.
    assert max(mapped) <= 64 < min(others)


def claims(first: int, pose: np.ndarray) -> list[np.ndarray | None]:
    return [None if k < first else TRUTH[k + 1] + pose for k in range(FRAMES)]


def test_right_late_wrong_and_silent_starts() -> None:
    errors = MapErrors(known(), TRUTH)
    right = scored(errors, 0, claims(19, np.array((0.0, 0.1, math.radians(1.0)))))
    assert right == pytest.approx(
        {
            "success": 1.0,
            "false_claims": 0.0,
            "frames": 20.0,
            "heading_rmse_deg": 1.0,
            "wrong_later": 0.0,
            "lost": 0.0,
        }
    )
    late = scored(errors, 0, claims(50, np.zeros(3)))
    assert (late["success"], late["false_claims"]) == (0.0, 0.0) and math.isnan(late["frames"])
    wrong = scored(errors, 0, claims(10, np.array((0.6, 0.0, 0.0))))
    assert (wrong["success"], wrong["false_claims"]) == (0.0, 1.0)
    silent = scored(errors, 0, [None] * FRAMES)
    assert (silent["success"], silent["false_claims"]) == (0.0, 0.0)
    some = claims(0, np.zeros(3))
    some[30:] = [None] * 15 + [np.array((99.0, 0.0, 0.0))] * 15
    later = scored(errors, 0, some)
    assert later["success"] == 1.0 and later["lost"] == pytest.approx(0.25)
    assert later["wrong_later"] == pytest.approx(15 / 45)


def test_starts_in_logs_are_counted_as_they_were_kept() -> None:
    found = [
        LogStart(True, True, True, 4.0, 0.1),
        LogStart(True, True, False, 9.0, 0.3),
        LogStart(True, True, True, 6.0, 0.2),
        LogStart(False, False, False, math.nan, 0.4),
    ]
    read = starts_of(as_arrays(found))
    assert summary_of(read) == summary_of(found)
    assert summary_of(read)["mapped"] == {
        "starts": 3,
        "right": 2,
        "false_claims": 1,
        "way_to_success_m": 5.0,
        "processor_s_per_m": pytest.approx(0.2),
    }
    assert summary_of(read)["unmapped"]["way_to_success_m"] is None
    assert starts_of(as_arrays([])) == []
