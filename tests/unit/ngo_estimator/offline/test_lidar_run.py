"""A run over recorded scans and wheels is what both cores give when they are fed by hand."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.lidar_run import LidarRun
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import LidarScan, WheelPose
from tests.unit.ngo_estimator.ray_casting import ROOM, cast, fan

ANGLES = fan(181, 240.0)
MOUNTING = Mounting(np.array((0.1, 0.05, 0.3)))
STEP_NS = 100_000_000
Record = LidarScan | WheelPose


def recorded(count: int, begin_ns: int = 10**12, further_left_rad: float = 0.0) -> list[Record]:
    """Wheels and scans, of a scanner that looks so much further to the left than ``MOUNTING`` says."""
    sensor = MOUNTING.sensor_xyyaw + (0.0, 0.0, further_left_rad)
    noise, pose, records = np.random.default_rng(0), np.array((1.0, 1.0, 0.2)), []
    for k in range(count):
        ranges = cast(ROOM, compose(pose, sensor), ANGLES) + noise.normal(0.0, 0.005, len(ANGLES))
        stamp_ns, increment = begin_ns + k * STEP_NS, float(ANGLES[1] - ANGLES[0])
        single = ranges.astype(np.float32)
        records += [
            WheelPose(stamp_ns, pose * (1.02, 1.02, 1.0)),
            LidarScan(stamp_ns, float(ANGLES[0]), increment, single, 0.05, 30.0, 0.0, "laser"),
        ]
        pose = compose(pose, np.array((0.06, 0.0, 0.03 + 0.1 * math.sin(0.3 * k))))
    return records


def run_over(
    records: Sequence[Record], config: MixtureConfig | None = None
) -> tuple[LidarRun, list[RecordedStep], list[RecordedRun]]:
    run = LidarRun(MixtureLidar(config), ScanTrajectory(iterations_per_step=1), MOUNTING)
    events = list(run.run(records))
    steps = [event for event in events if isinstance(event, RecordedStep)]
    return run, steps, [event for event in events if isinstance(event, RecordedRun)]


def test_it_equals_the_cores_fed_by_hand() -> None:
    records = recorded(60)
    run, steps, runs = run_over(records)
    odometry, online = MixtureLidar(mounting=MOUNTING), ScanTrajectory(iterations_per_step=1)
    updates = []
    for record in records:
        if isinstance(record, WheelPose):
            odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
        else:
            odometry.add_scan(record)
        updates += [online.update(step) for step in odometry.ready()]
    updates += [online.update(step) for step in odometry.ready(at_end=True)]
    online.finish()
    whole = online.trajectory()
    assert whole is not None and len(steps) == len(updates) == 59 and len(runs) == 1
    for ours, theirs in zip(steps, updates, strict=True):
        assert ours.update.pose_xyyaw.tobytes() == theirs.pose_xyyaw.tobytes()
        assert ours.update.covariance.tobytes() == theirs.covariance.tobytes()
    assert runs[0].trajectory.poses_xyyaw.tobytes() == whole.poses_xyyaw.tobytes()
    assert runs[0].walls is not None and len(runs[0].walls) > 500
    assert run.frames == 60 and not run.rejected and run.faults == [] and run.remarks() == []


def test_what_is_not_used_is_counted_and_ends_nothing() -> None:
    records = recorded(60)
    scans = [record for record in records if isinstance(record, LidarScan)]
    blind = LidarScan(*list(vars(scans[20]).values())[:3], np.full(181, np.nan, np.float32), 0.05, 30.0, 0.0, "laser")
    wild = WheelPose(scans[40].stamp_ns - 1, np.array((1e300, 0.0, 0.0)))
    changed = [blind if record is scans[20] else record for record in records]
    changed[70:70] = [scans[34], scans[30]]
    changed.insert(80, wild)
    run, steps, runs = run_over(changed)
    assert dict(run.rejected) == {
        "not usable": 1,
        "the stamp came twice": 1,
        "older than the scan before": 1,
        "wheel pose not usable": 1,
    }
    assert all("\n" not in example for example in run.examples.values()) and set(run.examples) == set(run.rejected)
    assert run.frames == 62 and len(steps) == 58 and len(runs) == 1


def test_stamps_that_jump_back_begin_another_trajectory() -> None:
    run, steps, runs = run_over([*recorded(40), *recorded(30, 10**11)])
    assert [len(each.trajectory.stamps_ns) for each in runs] == [40, 30] and len(steps) == 39 + 29
    _, _, alone = run_over(recorded(30, 10**11))
    assert runs[1].trajectory.poses_xyyaw.tobytes() == alone[0].trajectory.poses_xyyaw.tobytes()
    assert run.frames == 70


@pytest.mark.parametrize(("yaw", "side"), [(0.05, "left"), (-0.05, "right")])
def test_a_scanner_that_looks_elsewhere_than_its_mounting_says_is_told(yaw: float, side: str) -> None:
    config = MixtureConfig(certain_m=0.5, certain_rad=0.5)  # so that a short way tells it
    run, _, _ = run_over(recorded(120, further_left_rad=yaw), config)
    assert run.facts["mounting_yaw_deg"] == pytest.approx(math.degrees(yaw), abs=0.6)
    (remark,) = run.remarks()
    assert f"{abs(run.facts['mounting_yaw_deg']):.1f} deg further to the {side}" in remark
