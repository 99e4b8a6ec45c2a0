"""Report on a recording before training: its topics, their use, and its faults.

    python -m training.inspect_recording drive.mcap
    python -m training.inspect_recording part_0.mcap part_1.mcap --ground-truth tf:map:base_link --out drive.png

Prints the report and draws a picture beside the first file. The exit code is 1 where the recording cannot be used, with
one line that gives the reason and the remedy.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from ngo_common.files import written_whole
from ngo_estimator.offline.lidar_check import lidar_lines
from ngo_recordings.errors import RecordingError
from ngo_recordings.images import LIDAR_TYPES
from ngo_recordings.recording import Recording, open_recording
from ngo_recordings.topics import TopicArguments, choose_topics
from training.recordings.recording_picture import save_picture
from training.recordings.recording_report import REVISIT_AFTER_M, REVISIT_M, Report, inspect, topic_row


@dataclass(frozen=True)
class Arguments:
    """Settings of a report."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Files ending in .mcap or .db3, or folders of rosbag2; several count as one recording."""
    topics: Annotated[TopicArguments, tyro.conf.arg(name="")] = field(default_factory=TopicArguments)
    out: Path | None = None  # Picture to draw, a .png; not given: beside the first file.
    json: bool = False  # Print one JSON object instead of the report.


def main(arguments: Arguments) -> Report:
    """Inspect, draw and print. Raises RecordingError where the recording cannot be used."""
    with open_recording(arguments.files) as recording:
        if not arguments.json:
            print("\n".join(topic_table(recording)))
        topics = choose_topics(recording, arguments.topics)
        lidar: list[str] = []
        if recording.topics[topics.image].type_name in LIDAR_TYPES:
            if topics.action is None and arguments.topics.twist is None:  # a lidar takes no commanded velocities
                topics = replace(topics, twist=None)
            lidar = lidar_lines(recording, topics)
        report = inspect(recording, topics)
    first = arguments.files[0]
    out = first.with_name(first.name + ".png") if arguments.out is None else arguments.out
    with written_whole(out) as file:
        save_picture(report, file)
    if arguments.json:
        print(json.dumps({**report.numbers(), "lidar": lidar, "picture": str(out)}))
    else:
        of_lidar = ["", "lidar, as run_recording uses it:", *(f"  {line}" for line in lidar)] if lidar else []
        print("\n".join(["", *text(report), *of_lidar, "", f"picture: {out}"]))
    return report


def topic_table(recording: Recording) -> list[str]:
    """A line a topic."""
    lines = [f"{'topic':32} {'type':38} {'messages':>9} {'Hz':>8}"]
    for name in recording.topics:
        row = topic_row(recording, name)
        lines.append(f"{name:32} {row['type']:38} {row['count']:9d} {row['rate_hz']:8.2f}")
    return lines


def text(report: Report) -> list[str]:
    """The report in words."""
    lines = ["used:"]
    for name, use in report.uses.items():
        lines.append(f"  {name}: {use}")
        if name not in report.times:
            continue
        times = report.times[name]
        clock = (
            "no header: when it was logged counts"
            if times.without_header
            else "stamps of simulated time"
            if times.simulated
            else (
                f"stamp less log time {1e3 * times.skew_median_s:+.1f} ms (spread {1e3 * times.skew_spread_s:.1f} ms)"
            )
        )
        lines.append(
            f"    {times.rate_hz:.2f} Hz, longest gap {times.longest_gap_s:.3f} s; {clock}; "
            f"frames: {', '.join(times.frame_ids) or 'none'}"
        )
    unused = [name for name in report.topics if name not in report.uses]
    lines.append(f"not used: {', '.join(unused) or 'nothing'}")
    seconds = report.stamps_s[-1] - report.stamps_s[0] if len(report.stamps_s) else 0.0
    lines.append(f"frames: {report.frames} in {seconds:.1f} s, {report.image}")
    lines.append(
        f"  with a true pose {report.with_pose}, with an action {report.with_action}, "
        f"with a velocity {report.with_twist}"
    )
    if (motion := report.motion) is not None:
        (step_m, most_m, largest_m), (turn, most_turn, largest_turn) = motion.step_m, map(math.degrees, motion.step_rad)
        lines += [
            f"motion: {motion.path_m:.1f} m, {math.degrees(motion.turned_rad):.0f} deg turned",
            f"  a step: {step_m:.4f} m (95 % below {most_m:.4f}, largest {largest_m:.4f}), {turn:.3f} deg "
            f"(95 % below {most_turn:.3f}, largest {largest_turn:.3f}); standing still in {motion.standing:.0%}",
            f"  revisits: {motion.revisits:.0%} of the frames are within {REVISIT_M:g} m of a place passed at least "
            f"{REVISIT_AFTER_M:g} m of way earlier",
            f"  left out by the projection to the plane: {motion.height_range_m:.3f} m of height, tilt up to "
            f"{math.degrees(motion.largest_tilt_rad):.2f} deg",
        ]
    lines += [f"note: {problem}" for problem in report.problems]
    return lines


if __name__ == "__main__":
    try:
        main(tyro.cli(Arguments, description=__doc__))
    except RecordingError as problem:
        sys.exit(f"unusable: {problem}")
    except OSError as problem:
        sys.exit(f"inspect_recording: the picture cannot be written: {problem}")
