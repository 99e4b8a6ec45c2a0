"""Errors of trajectories: those of evo's programs on the same files, and values worked out by hand."""

import json
import os
import subprocess
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ngo_estimator.geometry.planar_motion import chained
from ngo_estimator.trajectory.errors import (
    RelativeDelta,
    Summary,
    absolute_errors,
    aligned,
    associate,
    relative_errors,
    segment_errors,
    take,
)
from ngo_estimator.trajectory.files import SpatialPoses, read_tum, write_tum

STEP_NS = 50_000_000


def drive(count: int, seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Planar poses ``(count, 3)`` of a winding drive with pauses, and an estimate that drifts from them."""
    rng = np.random.default_rng(seed)
    speed = np.where(np.arange(count) % 50 < 8, 0.0, rng.uniform(0.1, 0.3, count))
    steps = np.column_stack((speed, rng.normal(0.0, 0.02, count), rng.normal(0.02, 0.1, count)))
    return chained(steps[1:]), chained(steps[1:] + rng.normal(0.0, noise, steps.shape)[1:])


def in_space(poses: SpatialPoses, seed: int) -> SpatialPoses:
    """The same poses, tilted and shaken one by one."""
    rng = np.random.default_rng(seed)
    shake = Rotation.from_rotvec(rng.normal(0.0, 0.1, (len(poses), 3)))
    tilt = Rotation.from_rotvec([0.3, -0.2, 1.0])
    positions = tilt.apply(poses.positions_xyz + rng.normal(0.0, 0.02, (len(poses), 3))) + [5.0, -2.0, 1.0]
    return SpatialPoses(
        poses.stamps_ns, positions, (tilt * Rotation.from_quat(poses.quaternions_xyzw) * shake).as_quat()
    )


def write_spatial(path: Path, poses: SpatialPoses) -> None:
    np.savetxt(path, np.column_stack((poses.stamps_ns / 1e9, poses.positions_xyz, poses.quaternions_xyzw)), "%.12f")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """TUM files of a truth in space, and of a planar estimate at half its rate with other stamps and frame."""
    folder = tmp_path_factory.mktemp("evo")
    truth, estimate = drive(400, seed=0, noise=0.01)
    stamps_ns = 10**9 + np.arange(400) * STEP_NS
    write_spatial(folder / "truth.tum", in_space(SpatialPoses.from_planar(stamps_ns, truth), seed=1))
    # A third of the estimate's poses lie too far from any true one in time.
    shifts_ns = np.where(np.arange(200) % 3 == 0, 15_000_000, -4_000_000)
    write_tum(folder / "estimate.tum", stamps_ns[::2] + shifts_ns, estimate[::2])
    return folder / "estimate.tum", folder / "truth.tum"


def evo(program: str, files: tuple[Path, Path], *arguments: str) -> dict[str, float]:
    """The statistics that one of evo's programs saves about the two files."""
    estimate, truth = files
    saved = estimate.with_name("evo.zip")
    saved.unlink(missing_ok=True)
    command = [program, "tum", str(truth), str(estimate), "--no_warnings", "--save_results", str(saved), *arguments]
    environment = {**os.environ, "HOME": str(estimate.parent)}  # where it keeps settings of its own
    run = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert run.returncode == 0, run.stdout + run.stderr
    with zipfile.ZipFile(saved) as archive:
        statistics = json.loads(archive.read("stats.json"))
    del statistics["sse"]
    return statistics


def agree(ours: np.ndarray, theirs: dict[str, float]) -> None:
    found = asdict(Summary.of(ours))
    assert found.keys() == theirs.keys()
    assert found == pytest.approx(theirs, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize(("how", "flags"), [("none", []), ("first", ["--align_origin"]), ("best", ["--align"])])
def test_absolute_errors_are_those_of_evo_ape(files: tuple[Path, Path], how: str, flags: list[str]) -> None:
    estimate, truth = associate(read_tum(files[0]), read_tum(files[1]))
    assert 100 < len(estimate) < 200
    errors = absolute_errors(aligned(estimate, truth, how), truth)  # type: ignore[arg-type]
    agree(errors.translation_m, evo("evo_ape", files, "-r", "trans_part", *flags))
    if how == "best":
        agree(errors.rotation_deg, evo("evo_ape", files, "-r", "angle_deg", *flags))


@pytest.mark.parametrize("delta", [
    RelativeDelta(),
    RelativeDelta(7, "frames"),
    RelativeDelta(7, "frames", all_pairs=True),
    RelativeDelta(1.3, "metres"),
    RelativeDelta(1.3, "metres", all_pairs=True),
])  # fmt: skip
def test_relative_errors_are_those_of_evo_rpe(files: tuple[Path, Path], delta: RelativeDelta) -> None:
    """Whatever the alignment is; rotations are of the same pairs."""
    estimate, truth = associate(read_tum(files[0]), read_tum(files[1]))
    errors = relative_errors(aligned(estimate, truth, "best"), truth, delta)
    flags = ["-d", str(delta.size), "-u", {"frames": "f", "metres": "m"}[delta.unit]]
    flags += ["--all_pairs"] * delta.all_pairs
    agree(errors.translation_m, evo("evo_rpe", files, "-r", "trans_part", *flags))
    if delta.all_pairs:
        agree(errors.rotation_deg, evo("evo_rpe", files, "-r", "angle_deg", "--align", *flags))


def test_association_is_by_the_nearest_stamp_and_the_same_both_ways_around() -> None:
    poses = SpatialPoses.from_planar(np.arange(6) * 10, np.column_stack((np.arange(6.0), np.zeros((6, 2)))))
    others = SpatialPoses.from_planar(np.array([4, 14, 26, 90]), np.zeros((4, 3)))
    first, second = associate(poses, others, tolerance_s=4e-9)
    assert (first.stamps_ns.tolist(), second.stamps_ns.tolist()) == ([0, 10, 30], [4, 14, 26])
    second, first = associate(others, poses, tolerance_s=4e-9)
    assert (first.stamps_ns.tolist(), second.stamps_ns.tolist()) == ([0, 10, 30], [4, 14, 26])
    one = take(poses, np.array([2]))
    assert [len(part) for part in associate(one, poses)] == [1, 1]
    with pytest.raises(ValueError, match=r"no pose of the estimate \(0.000 to 0.000 s\) lies within 0.01 s"):
        associate(poses, SpatialPoses(poses.stamps_ns + 10**9, poses.positions_xyz, poses.quaternions_xyzw))


def circle(count: int, radius_m: float) -> np.ndarray:
    """Poses along a circle, driven around in ``count - 1`` steps of one metre of path each."""
    angle = np.arange(count) / radius_m
    return np.column_stack((radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle)), angle))


def planar(poses: np.ndarray) -> SpatialPoses:
    return SpatialPoses.from_planar(np.arange(len(poses)) * STEP_NS, poses)


def test_segment_errors_of_a_scaled_straight_path() -> None:
    """A straight path measured 2 % too long is wrong by 2 % of each segment, which ends one frame after its length."""
    truth = np.column_stack((np.arange(61.0), np.zeros((61, 2))))
    errors = segment_errors(planar(truth * [1.02, 1.0, 1.0]), planar(truth), (10.0, 20.0, 80.0))
    # Segments begin at the frames 0, 10 .. 60; 11 steps reach beyond 10 m, 21 beyond 20 m.
    assert errors.segments == {10.0: 5, 20.0: 4, 80.0: 0}
    assert errors.translation_percent == pytest.approx((5 * 2.0 * 11 / 10 + 4 * 2.0 * 21 / 20) / 9)
    assert errors.rotation_deg_per_m == pytest.approx(0.0, abs=1e-9)


def test_segment_errors_of_a_turn_rate_that_is_wrong() -> None:
    """A bias of 0.1 deg in each step of 1 m, on segments of 20 m that end at 21 steps."""
    truth = circle(101, 30.0)
    estimate = truth.copy()
    estimate[:, 2] += np.radians(0.1) * np.arange(101)
    errors = segment_errors(planar(estimate), planar(truth), (20.0,))
    lengths = errors.segments[20.0]
    assert lengths == 8 and errors.rotation_deg_per_m == pytest.approx(0.1 * 21 / 20)


def segment_errors_by_loops(
    estimate: list[np.ndarray], truth: list[np.ndarray], lengths_m: list[float]
) -> tuple[float, float]:
    """The published definition with matrices, a segment at a time."""
    travelled = [0.0]
    for before, after in zip(truth, truth[1:], strict=False):
        travelled.append(travelled[-1] + float(np.linalg.norm(after[:3, 3] - before[:3, 3])))
    translations, rotations = [], []
    for start in range(0, len(truth), 10):
        for length in lengths_m:
            beyond = [k for k in range(start, len(truth)) if travelled[k] > travelled[start] + length]
            if not beyond:
                continue
            motions = [np.linalg.inv(poses[start]) @ poses[beyond[0]] for poses in (estimate, truth)]
            error = np.linalg.inv(motions[0]) @ motions[1]
            translations.append(np.linalg.norm(error[:3, 3]) / length)
            rotations.append(np.arccos(np.clip((np.trace(error[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)) / length)
    return 100.0 * float(np.mean(translations)), float(np.degrees(np.mean(rotations)))


def test_segment_errors_follow_the_definition_in_space() -> None:
    true, estimated = drive(500, seed=3, noise=0.02)
    truth, estimate = in_space(planar(true), 0), in_space(planar(estimated), 5)
    matrices = []
    for poses in (estimate, truth):
        some = np.tile(np.eye(4), (len(poses), 1, 1))
        some[:, :3, :3] = Rotation.from_quat(poses.quaternions_xyzw).as_matrix()
        some[:, :3, 3] = poses.positions_xyz
        matrices.append(list(some))
    errors = segment_errors(estimate, truth, (5.0, 10.0, 20.0, 40.0))
    expected = segment_errors_by_loops(*matrices, [5.0, 10.0, 20.0, 40.0])
    assert (errors.translation_percent, errors.rotation_deg_per_m) == pytest.approx(expected)


def test_a_path_too_short_for_all_segments_is_said() -> None:
    truth = planar(circle(62, 30.0))
    with pytest.raises(ValueError, match=r"true path is 61\.0 m long: too short for segments of 100, 200 m"):
        segment_errors(truth, truth, (100.0, 200.0))
    with pytest.raises(ValueError, match="expected some above 0 m"):
        segment_errors(truth, truth, ())
