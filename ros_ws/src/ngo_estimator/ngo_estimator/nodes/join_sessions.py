"""Lay saved sessions of a lidar into one map.

    ros2 run ngo_estimator join_sessions monday tuesday --out both

SESSIONS are folders that `~/save_state` of `ngo_node` wrote. OUT is such a folder, in the map of the first session. A
session that nothing ties to that map is named and left out.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from ament_index_python.packages import get_package_share_directory
from rich.console import Console

from ngo_estimator.data.lidar_file import is_lidar
from ngo_estimator.nodes.command import run_command
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.saved_state import identity_of
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.session import Session
from ngo_estimator.slam.session_union import united
from ngo_estimator.slam.tf_smoothing import SmoothedCorrection

NAME = "join_sessions"


@dataclass(frozen=True)
class Arguments:
    """The sessions, and where the joined one goes."""

    sessions: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of saved states, two or more; the first one gives the map."""
    out: Path  # Folder to write the joined state to.
    weights: Path | None = None  # Folder of weights of your own, with which the sessions were made.

    def check(self) -> None:
        """Raise ``ValueError`` for arguments that no run can have."""
        if len(self.sessions) < 2:
            raise ValueError(f"there are {len(self.sessions)} sessions; expected two or more")
        if self.out.exists():
            raise ValueError(f"{self.out} is there already; give another --out")
        if not self.out.absolute().parent.is_dir():
            raise ValueError(f"--out is '{self.out}', whose parent folder is not there")


def run(arguments: Arguments, console: Console) -> list[Path]:
    """Join the sessions, write the result, and return those that were left out.

    Raises:
        ValueError: of one line, about sessions or folders that cannot be used, or where no two sessions meet.
    """
    arguments.check()
    world = str(identity_of(arguments.sessions[0]).get("world"))
    folder = arguments.weights or Path(get_package_share_directory("ngo_estimator"), "weights", world)
    if not (folder.is_dir() and is_lidar(folder)):
        raise ValueError(f"{arguments.sessions[0]} is of world '{world}'; expected sessions of a lidar")
    empty = ScanTrajectory.load(folder, world)
    blank = Session(world, empty, MapOrigin.of_first_pose(np.zeros(3)), SmoothedCorrection(0.0))
    sessions = [blank.loaded(path) for path in arguments.sessions]
    cores = [session.core for session in sessions if isinstance(session.core, ScanTrajectory)]
    with console.status("driving the sessions again"):
        union = united(cores)
    left_out = [arguments.sessions[number] for number in union.left_out]
    for path, later_ns in zip(arguments.sessions, union.later_ns, strict=True):
        if path in left_out:
            console.print(f"{path} is left out: nothing shows where it lies in the map of {arguments.sessions[0]}")
        elif later_ns:
            console.print(f"{path} did not begin after the others: its stamps are {later_ns * 1e-9:.3f} s later now")
    if len(left_out) == len(sessions) - 1:
        raise ValueError("no session meets the first one: nothing was written")
    joined = replace(sessions[0], core=union.trajectory)
    joined.write(arguments.out, joined.state())
    frames = union.trajectory.newest().frames
    console.print(f"wrote {len(sessions) - len(left_out)} sessions, {frames} poses, to {arguments.out}")
    return left_out


def main() -> None:
    """Run with the command line's arguments."""
    run_command(NAME, Arguments, __doc__, run)


if __name__ == "__main__":
    main()
