"""The report on a recording: its numbers are right, and each thing that is wrong is told in one line with a remedy."""

import json
import math
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ngo_recordings.errors import RecordingError
from ngo_recordings.recording import open_recording
from ngo_recordings.topics import TopicArguments, choose_topics
from tests.unit.ngo_recordings import messages as m
from training.inspect_recording import Arguments, main
from training.recordings.recording_report import Report, inspect, revisits

S = 10**9
ROOT = Path(__file__).parents[3]


def square(side: int = 8, laps: float = 2.0, step_m: float = 0.25) -> np.ndarray:
    """Poses ``(frames, 3)`` around a square of side m."""
    steps = round(laps * 4 * side / step_m)
    along = np.arange(steps) * step_m % (4 * side)
    edge, rest = (along // side).astype(int), along % side
    corners = np.array([(0, 0), (side, 0), (side, side), (0, side)], float)
    heading = edge * math.pi / 2
    return np.column_stack((corners[edge] + rest[:, None] * np.stack((np.cos(heading), np.sin(heading)), 1), heading))


def drive(poses: np.ndarray, late_s: float = 0.0, tilt: float = 0.0) -> list[m.Entry]:
    """An image, the truth and an action every 0.1 s, logged 20 ms after their stamps."""
    entries: list[m.Entry] = []
    for k, (x, y, yaw) in enumerate(poses.tolist()):
        stamp_ns = 10 * S + k * S // 10
        true_ns = stamp_ns + round(late_s * S)
        at = m.pose(x, y, yaw, z=0.001 * k, roll=tilt)
        log_ns = stamp_ns + 20_000_000
        entries.append(("/ground_truth", log_ns, m.odometry(true_ns, at, m.twist(0.0, 0.0, 0.0))))
        entries.append(("/image", log_ns, m.image(stamp_ns, np.full((2, 8, 3), k % 256, np.uint8))))
        entries.append(("/action", log_ns, m.action(stamp_ns, 0)))
    return entries


def report_of(path: Path, given: TopicArguments | None = None) -> Report:
    with open_recording([path]) as recording:
        return inspect(recording, choose_topics(recording, given))


def test_the_numbers_are_those_of_the_drive(tmp_path: Path) -> None:
    report = report_of(m.write_mcap(tmp_path / "a.mcap", drive(square())))
    assert report.problems == ()
    assert (report.frames, report.with_pose, report.with_action, report.with_twist) == (256, 256, 255, 0)
    assert report.image == "8 x 2, colour"
    assert report.uses == {
        "/image": "image", "/action": "action of each step", "/ground_truth": "ground truth"
    }  # fmt: skip
    times = report.times["/image"]
    assert math.isclose(times.rate_hz, 10.0) and math.isclose(times.longest_gap_s, 0.1) and times.gaps == 0
    assert math.isclose(times.skew_median_s, -0.02, abs_tol=1e-9) and times.skew_spread_s < 1e-9
    assert report.times["/ground_truth"].frame_ids == ("map -> base_link",)
    motion = report.motion
    assert motion is not None
    assert math.isclose(motion.path_m, 255 * 0.25) and math.isclose(motion.step_m[0], 0.25)
    assert math.isclose(motion.turned_rad, 7 * math.pi / 2) and math.isclose(motion.step_rad[2], math.pi / 2)
    assert math.isclose(motion.height_range_m, 0.255)
    # The second lap, and the last metre of the first, which comes back to the start.
    assert math.isclose(motion.revisits, (128 + 4) / 256, abs_tol=1.5 / 256)


def test_a_straight_way_revisits_nothing_and_a_way_back_all_of_it() -> None:
    out = np.column_stack((np.arange(0.0, 40.0, 0.1), np.zeros(400)))
    assert revisits(out) == 0.0
    there_and_back = np.concatenate((out, out[::-1]))
    # But for the turning point, where 5 m of way have to lie between.
    assert math.isclose(revisits(there_and_back), 0.5, abs_tol=0.04)


Change = Callable[[list[m.Entry]], list[m.Entry]]


def without(topic: str, which: Callable[[int], bool] = lambda number: True) -> Change:
    """Leave out messages of a topic, by their numbers."""

    def change(entries: list[m.Entry]) -> list[m.Entry]:
        numbers: Counter[str] = Counter()
        kept = []
        for entry in entries:
            if entry[0] != topic or not which(numbers[topic]):
                kept.append(entry)
            numbers[entry[0]] += 1
        return kept

    return change


def twice(entries: list[m.Entry]) -> list[m.Entry]:
    """Play it a second time, with the stamps that it had."""
    return [*entries, *((topic, time_ns + 100 * S, message) for topic, time_ns, message in entries)]


@pytest.mark.parametrize(
    ("change", "given", "problem"),
    [
        (without("/ground_truth"), {}, "there is no ground truth, which training needs .*candidates here: none"),
        (list, {"ground_truth": "none"}, "name it with --ground-truth.*candidates here: /ground_truth"),
        (without("/image", lambda k: 100 <= k < 110), {}, "/image has 1 gaps of up to 1.1"),
        (without("/action", lambda k: k % 2 == 0), {}, "50% of the steps have a message of /action .*--action none"),
        (without("/ground_truth", lambda k: k >= 100), {}, "39% of the frames have a true pose"),
        (lambda _: drive(square(), late_s=3.0), {}, r"/ground_truth is stamped \+3.00 s from /image: the clocks"),
        (lambda _: drive(square(), tilt=math.pi / 2), {}, "tilts by up to 90 deg.*optical frame"),
        (lambda _: drive(0.001 * square()), {}, "the robot moves 0.06 m in all"),
        (lambda _: drive(square()[:120]), {}, "120 frames with a true pose are few .*: record"),
        (lambda _: drive(square()[:120]), {}, "0% of the frames show a place that was passed before: .* drive rounds"),
        (twice, {}, "stamps of /image repeat or go back"),
    ],
)
def test_what_is_wrong_is_told_with_its_remedy(
    tmp_path: Path, change: Change, given: dict[str, str], problem: str
) -> None:
    path = m.write_mcap(tmp_path / "a.mcap", change(drive(square())))
    report = report_of(path, TopicArguments(**given))  # type: ignore[arg-type]
    assert len([line for line in report.problems if re.search(problem, line)]) == 1, report.problems
    assert all("\n" not in line for line in report.problems)


def test_transforms_that_do_not_meet_are_listed(tmp_path: Path) -> None:
    entries = drive(square())
    entries += [("/tf", 10 * S, m.transforms(m.transform(10 * S, "odom", "base_link", m.pose(0.0, 0.0, 0.0))))]
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    report = report_of(path, TopicArguments(ground_truth="tf:map:base_link"))
    (line,) = (line for line in report.problems if "0% of the frames have a true pose" in line)
    assert "transforms here:" in line and "odom -> base_link" in line


def test_the_script_prints_a_report_draws_a_picture_and_speaks_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = m.write_mcap(tmp_path / "a.mcap", drive(square()))
    main(Arguments((path,)))
    text = capsys.readouterr().out
    assert "motion: 63.8 m, 630 deg turned" in text and "/image: image" in text and "256 frames" not in text
    assert f"picture: {tmp_path / 'a.mcap.png'}" in text
    with Image.open(tmp_path / "a.mcap.png") as picture:
        assert picture.format == "PNG" and picture.width > 1000
    main(Arguments((path,), out=tmp_path / "b.png", json=True))
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["frames"] == 256 and numbers["motion"]["path_m"] == pytest.approx(63.75)
    assert numbers["picture"] == str(tmp_path / "b.png") and (tmp_path / "b.png").exists()


def test_simulated_time_that_passes_at_a_pace_of_its_own_is_no_fault(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    began_ns = 1_700_000_000 * S
    # A tenth of the pace of the clock of the day, by which it was logged.
    entries = [(topic, began_ns + 10 * (time_ns - 10 * S), message) for topic, time_ns, message in drive(square())]
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    report = main(Arguments((path,)))
    assert report.problems == ()
    assert report.times["/image"].skew_spread_s > 100.0
    assert capsys.readouterr().out.count("stamps of simulated time") == 3
    # The same of a driver's clock: it began on the same day.
    late = [(topic, 20 * S + 10 * time_ns, message) for topic, time_ns, message in drive(square())]
    report = report_of(m.write_mcap(tmp_path / "b.mcap", late))
    assert any("stamps of /image drift" in line for line in report.problems)


def test_what_is_unusable_ends_with_one_line_and_exit_code_1(tmp_path: Path) -> None:
    path = m.write_mcap(tmp_path / "a.mcap", [("/image", 1, m.image(1, np.zeros((2, 2, 2), np.uint8), "yuv422"))])
    with pytest.raises(RecordingError, match="'yuv422'; supported"):
        main(Arguments((path,)))
    command = [sys.executable, "-m", "training.inspect_recording", str(path)]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == 1
    assert ended.stderr.startswith("unusable: images of /image are 'yuv422'; supported: rgb8")
    assert ended.stderr.count("\n") == 1


def test_a_lidars_recording_is_shown_as_run_recording_uses_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entries: list[m.Entry] = [("/tf_static", 1, m.transforms(m.transform(0, "base_link", "laser", m.pose(0.2, 0, 0))))]
    for k in range(30):
        stamp_ns = 10 * S + k * S // 10
        made = m.scan(stamp_ns, np.linspace(1.0, 4.0, 90) + 0.01 * k, increment=0.05)
        made.header.frame_id = "laser"
        entries.append(("/scan", stamp_ns, made))
        wheels = m.odometry(stamp_ns, m.pose(0.01 * k, 0, 0), m.twist(0, 0, 0))
        wheels.header.frame_id = "odom"
        entries += [("/odom", stamp_ns, wheels), ("/cmd_vel", stamp_ns, m.twist(0.1, 0, 0))]
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    report = main(Arguments((path,), out=tmp_path / "a.png"))
    assert set(report.uses) == {"/scan", "/odom", "/tf_static"}
    told = capsys.readouterr().out
    assert "not used: /cmd_vel" in told and "mounting: laser in base_link at x 0.200 m" in told
    assert "wheels: /odom, 30 poses" in told
