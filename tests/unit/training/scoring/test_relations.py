"""The Freiburg benchmark's metric: answers computed on paper, and its own script where it is at hand."""

import importlib.util
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ngo_estimator.geometry import se2
from training.data.lidar_drives import Relations
from training.scoring.relations import interpolated, relation_errors


def relations(*rows: tuple[float, float, float, float, float]) -> Relations:
    table = np.array(rows)
    return Relations(table[:, :2], table[:, 2:])


def test_error_is_seen_from_the_first_pose() -> None:
    # North for 2 m: straight ahead as the robot sees it. The relation says 1.5 m, 0.2 m to the left, and 0.1 rad.
    poses = np.array(((5.0, 1.0, math.pi / 2), (5.0, 3.0, math.pi / 2)))
    found = relation_errors(relations((0.0, 1.0, 1.5, 0.2, 0.1)), np.array((0.0, 1.0)), poses)
    assert found.translation_m == pytest.approx([math.hypot(0.5, 0.2)])
    assert found.rotation_deg == pytest.approx([math.degrees(0.1)])
    assert found.left_out == 0


def test_poses_between_stamps_are_interpolated_and_headings_go_the_short_way() -> None:
    poses = np.array(((0.0, 0.0, 3.0), (2.0, 0.0, -3.0)))
    halfway = interpolated(np.array((0.0, 1.0)), poses, np.array((0.5,)))[0]
    assert halfway == pytest.approx([1.0, 0.0, math.pi])
    found = relation_errors(relations((0.0, 1.0, 2.0 * math.cos(3.0), -2.0 * math.sin(3.0), 2.0 * math.pi - 6.0)),
                            np.array((0.0, 1.0)), poses)  # fmt: skip
    assert found.translation_m == pytest.approx([0.0], abs=1e-12)
    assert found.rotation_deg == pytest.approx([0.0], abs=1e-9)


def test_relations_beyond_the_estimate_are_counted_and_far_ones_are_told_apart() -> None:
    stamps = np.arange(0.0, 101.0)
    poses = np.stack((stamps, np.zeros(101), np.zeros(101)), axis=-1)
    wanted = relations((0.0, 10.0, 10.0, 0.0, 0.0), (0.0, 90.0, 89.0, 0.0, 0.0), (50.0, 101.0, 0.0, 0.0, 0.0))
    found = relation_errors(wanted, stamps, poses)
    assert found.left_out == 1
    assert found.far.tolist() == [False, True]
    assert found.translation_m == pytest.approx([0.0, 1.0])


def test_what_cannot_be_measured_is_refused() -> None:
    poses = np.zeros((2, 3))
    with pytest.raises(ValueError, match="do not increase"):
        relation_errors(relations((0.0, 1.0, 0.0, 0.0, 0.0)), np.array((1.0, 1.0)), poses)
    with pytest.raises(ValueError, match="none of 1 relations"):
        relation_errors(relations((5.0, 6.0, 0.0, 0.0, 0.0)), np.array((0.0, 1.0)), poses)
    with pytest.raises(ValueError, match="expected"):
        relation_errors(relations((0.0, 1.0, 0.0, 0.0, 0.0)), np.array((0.0, 1.0)), np.zeros((3, 3)))


finite = st.floats(-50.0, 50.0)


@settings(max_examples=50, deadline=None)
@given(finite, finite, st.floats(-3.0, 3.0), st.integers(0, 2**32 - 1))
def test_no_alignment_matters(x: float, y: float, yaw: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps, poses = np.arange(20.0), np.cumsum(rng.normal(0.0, 0.3, (20, 3)), axis=0)
    wanted = relations(*((0.5 * k, 0.5 * k + 3.3, *rng.normal(0.0, 0.5, 3)) for k in range(12)))
    moved = se2.compose(np.array((x, y, yaw)), poses)
    before, after = (relation_errors(wanted, stamps, each) for each in (poses, moved))
    np.testing.assert_allclose(after.translation_m, before.translation_m, atol=1e-9)
    np.testing.assert_allclose(after.rotation_deg, before.rotation_deg, atol=1e-9)


def test_the_same_as_the_script_beside_the_logs() -> None:
    folder = os.environ.get("NGO_LIDAR_LOGS")
    if folder is None:
        pytest.skip("NGO_LIDAR_LOGS names no folder of logs")
    spec = importlib.util.spec_from_file_location("script", Path(folder) / "relation_errors.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    table = np.loadtxt(Path(folder) / "aces.relations")
    rng = np.random.default_rng(0)
    stamps = np.linspace(table[:, 0].min() - 1.0, table[:, 1].max() + 1.0, 5000)
    poses = np.cumsum(rng.normal(0.0, 0.05, (5000, 3)), axis=0)
    metres, radians = script.relation_errors(table, stamps, poses)
    found = relation_errors(Relations(table[:, :2], table[:, [2, 3, 7]]), stamps, poses)
    np.testing.assert_allclose(found.translation_m, metres, atol=1e-9)
    np.testing.assert_allclose(found.rotation_deg, np.degrees(radians), atol=1e-9)
