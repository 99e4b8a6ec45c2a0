"""Run a SLAM program of MRPT (Debian's ``mrpt-apps``) over a recording, and write its trajectory in the TUM format.

    python -m benchmarks.mrpt_slam my.log --program rbpf-slam --out rbpf.tum

The recording needs a 2D lidar and wheel odometry.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from training.baselines import mrpt_slam
from training.recordings.lidar_logs import read_drive


@dataclass(frozen=True)
class Arguments:
    """Settings of a run."""

    recording: Annotated[Path, tyro.conf.Positional]
    """Recording with scans and wheel odometry: a bag, or a CARMEN log."""
    out: Path
    """File that gets the trajectory."""
    program: mrpt_slam.Program = "rbpf-slam"
    """Which program."""


def main(arguments: Arguments) -> int:
    """Run it; returns the exit status, 0 also where the program is not installed."""
    if lacking := mrpt_slam.missing(arguments.program):
        print(f"skipped: {lacking}")
        return 0
    drive = read_drive(arguments.recording)
    found = mrpt_slam.run(arguments.program, drive, mrpt_slam.MrptConfig())
    half = 0.5 * found.poses_xyyaw[:, 2]
    nothing = np.zeros(len(half))
    columns = (*found.poses_xyyaw[:, :2].T, nothing, nothing, nothing, np.sin(half), np.cos(half))
    with arguments.out.open("w") as stream:
        for stamp_ns, *row in zip(found.stamps_ns.tolist(), *columns, strict=True):
            stamp = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
            stream.write(f"{stamp} {' '.join(f'{value:.6f}' for value in row)}\n")
    print(f"{arguments.program}: {len(half)} poses in {arguments.out}, {found.took_s:.1f} s of computing time")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
