"""The run over recorded frames: its cores see what the live nodes' cores would, and what is left out is counted."""

from dataclasses import replace

import numpy as np
import torch

from ngo_estimator.checkpoint import PlaceNetworks
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.local_odometry import LocalEstimate, LocalOdometry
from ngo_estimator.networks.local_pose_network import LocalPoseNetwork
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep
from ngo_estimator.offline.recording_run import RecordingRun
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from ngo_recordings.frames import Frame
from tests.unit.ngo_estimator.samples import local_config, observations, place_config, small_optimizer, small_pair_head

STEP_NS = 100_000_000
ROUNDING = 1e-6  # Of single precision (m, rad): networks run over several frames at once round otherwise than over one.
START_NS = 1_700_000_000_000_000_000


def cores(**changes: object) -> tuple[LocalOdometry, OnlineTrajectory]:
    torch.manual_seed(0)
    config = local_config("maze2d", feature_size=6, relative_std=(0.1, 0.02, 0.05), **changes)
    place = PlaceNetworks(place_config("maze2d", code_size=12))
    return LocalOdometry(LocalPoseNetwork(config), place, "maze2d"), OnlineTrajectory(
        small_optimizer(trained=True), small_pair_head(), 64
    )


def recorded(count: int, start_ns: int = START_NS) -> list[Frame]:
    """Frames as a recording gives them: with the step that led to each, and the truth about it."""
    return [
        Frame(
            stamp_ns=start_ns + k * STEP_NS,
            image=image,
            action=(k - 1) % 3 if k else None,
            pose_xyyaw=np.array([0.1 * k, 1.0, 0.01 * k]),
            pose_residual=np.array([0.5, 0.1, -0.1]),
        )
        for k, image in enumerate(observations("maze2d", count, seed=start_ns % 1000).numpy())
    ]


def run(frames: list[Frame], **changes: object) -> tuple[RecordingRun, list[RecordedStep], list[RecordedRun]]:
    core = RecordingRun(*cores(**changes))
    events = list(core.run(frames))
    return (
        core,
        [event for event in events if isinstance(event, RecordedStep)],
        [event for event in events if isinstance(event, RecordedRun)],
    )


def directly(
    frames: list[Frame], actions: list[int | None]
) -> tuple[list[tuple[LocalEstimate, TrajectoryUpdate]], Trajectory]:
    """What the cores say about these frames, called by hand, and the whole trajectory in the end."""
    local, online = cores()
    result = []
    for frame, action in zip(frames, actions, strict=True):
        estimate = local.update(frame.stamp_ns, frame.image, action)
        if estimate is not None:
            values = {name: getattr(estimate, name) for name in RelativeStep.__dataclass_fields__}
            result.append((estimate, online.update(RelativeStep(**values))))
    trajectory = online.trajectory()
    assert trajectory is not None
    return result, trajectory


def check(steps: list[RecordedStep], found: RecordedRun, frames: list[Frame], actions: list[int | None]) -> None:
    expected, last = directly(frames, actions)
    assert [step.local.stamp_ns for step in steps] == [estimate.stamp_ns for estimate, _ in expected]
    for step, (estimate, update) in zip(steps, expected, strict=True):
        np.testing.assert_allclose(step.local.odom_xyyaw, estimate.odom_xyyaw, atol=ROUNDING)
        np.testing.assert_allclose(step.update.pose_xyyaw, update.pose_xyyaw, atol=ROUNDING)
    np.testing.assert_allclose(found.trajectory.poses_xyyaw, last.poses_xyyaw, atol=ROUNDING)
    np.testing.assert_allclose(found.trajectory.online_xyyaw, last.online_xyyaw, atol=ROUNDING)
    np.testing.assert_array_equal(found.trajectory.stamps_ns, last.stamps_ns)


def test_every_frame_goes_through_both_cores() -> None:
    frames = recorded(30)
    core, steps, (found,) = run(frames)
    check(steps, found, frames, [frame.action for frame in frames])
    assert core.frames == 30 and not core.rejected and core.gaps == 0
    assert found.truth is not None
    np.testing.assert_allclose(found.truth.planar(), [frame.pose_xyyaw for frame in frames])
    np.testing.assert_array_equal(found.truth_residual, [frame.pose_residual for frame in frames])


def test_what_cannot_be_used_is_left_out_and_counted() -> None:
    frames = recorded(20)
    broken = frames[5].image.copy()
    broken[0, 3, 1] = np.nan
    played = [
        *frames[:5],
        replace(frames[5], image=broken),
        *frames[6:9],
        frames[8],  # again
        *frames[9:12],
        frames[10],  # late
        replace(frames[12], image=frames[12].image[:, :100]),
        *frames[13:],
    ]
    core, steps, (found,) = run(played)
    used = [frame for k, frame in enumerate(frames) if k not in (5, 12)]
    # Over a frame of another size the first action after the frame before it counts; not so over one with broken
    # values, which is seen only when it is used.
    actions = [(frames.index(frame) - 1) % 3 if frame is not frames[0] else None for frame in used]
    actions[11] = 11 % 3
    check(steps, found, used, actions)
    assert core.rejected == {"the stamp came twice": 1, "older than the frame before": 1, "not usable": 2}
    assert "1 values that are not finite" in core.examples["not usable"]
    assert "1700000000.800000000 s: " in core.examples["the stamp came twice"]
    assert core.gaps == 2


def test_a_jump_back_in_time_begins_a_new_trajectory() -> None:
    first, second = recorded(20), recorded(15, START_NS - 3600 * 10**9)
    core, steps, found = run([*first, *second])
    assert len(found) == 2 and core.frames == 35 and not core.rejected
    for part, part_steps, frames in zip(found, (steps[:19], steps[19:]), (first, second), strict=True):
        check(part_steps, part, frames, [frame.action for frame in frames])
        assert part.truth is not None and part.truth.stamps_ns.tolist() == [frame.stamp_ns for frame in frames]


def test_velocities_lead_to_frames() -> None:
    frames = [
        replace(frame, action=None, twist_xyyaw=np.array([1.0, 0.0, 0.1 * k]) if k else None)
        for k, frame in enumerate(recorded(10))
    ]
    settings = {"actions": 0, "twist": True}
    core, steps, _ = run(frames, **settings)
    local = cores(**settings)[0]
    expected = [local.update(frame.stamp_ns, frame.image, None, frame.twist_xyyaw) for frame in frames][1:]
    assert len(steps) == 9 and not core.rejected
    for step, estimate in zip(steps, expected, strict=True):
        assert estimate is not None
        np.testing.assert_allclose(step.local.relative_xyyaw, estimate.relative_xyyaw, atol=ROUNDING)
