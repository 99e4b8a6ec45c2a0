"""How good ``world:=camera`` is on Doom maps: odometry and loops from pictures of 640 x 480, without training.

    python -m training.results --world camera --split validation
    python -m training.results --world camera
    python -m training.results --world camera --named take_cover MAP27
    python -m training.results --world camera --split validation --without corrector
    python -m training.results --world camera --places rooms --seeds 3 --frames 600
    python -m training.results --world camera --places mazes --seeds 3 --frames 600 --without wheels

A drive of the explorer on each map, drives through mazes, or rounds in rooms of another renderer (``room_drives``). The
motion given is that of wheels with errors (``given_motion``); without wheels the floor gives the scale. The command
prints a table and writes ``training/results/camera.json``: each drive, and rows with means over drives. Run it again to
continue after a stop. Drives of as many frames that are published and that the code of today has not measured stay, and
name their revision.
"""

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ngo_estimator.frontend.camera import picture_odometry
from ngo_estimator.frontend.camera.camera_config import CameraConfig
from ngo_estimator.loops.picture_settings import PictureGraphConfig
from ngo_estimator.slam import picture_trajectory
from ngo_sim import episodes, maze3d
from training.common import records
from training.common.command_line import check_at_least, run_command
from training.data.doom_drives import TEST_MAPS, VALIDATION_MAPS
from training.report.folders import with_earlier
from training.scoring import camera_rows, room_drives
from training.scoring.camera_rows import Ablation, camera_drive, maze_drive, measured
from training.scoring.room_drives import room_drive
from training.scoring.table import Drive, Numbers, Row, Rows, interval_of, measure

_MAPS = {"validation": VALIDATION_MAPS, "test": TEST_MAPS}
_FIRST_SEED = {"validation": 10_000, "test": 20_000}
_Drives = dict[str, dict[str, Any]]
"""By the drive's name its numbers; ``revision`` where an older one measured them."""

_ROOM_CODE = (room_drives,)
_DRIVE_CODE, _ROW_CODE = (episodes, maze3d), (camera_rows, picture_odometry, picture_trajectory)


@dataclass(frozen=True)
class Arguments:
    """Settings of the measurement."""

    places: Literal["doom", "mazes", "rooms"] = "doom"  # Maps; mazes, rooms of another renderer: own files.
    split: Literal["validation", "test"] = "test"  # Maps to measure on; settings are chosen on validation.
    seeds: int = 1  # Drives of each map, or rooms.
    frames: int = 1000  # Frames of a drive.
    maps: int = 0  # Number of maps; 0: all.
    without: Ablation = "nothing"  # An ablation, in a file of its own.
    named: tuple[str, ...] = ()  # Words of which one is in the name of each map to measure, as take_cover; none: all.
    results: Path = records.ROOT / "training" / "results"  # Folder of camera.json.
    runs: Path = records.ROOT / "runs"  # Folder of what was measured.

    def __post_init__(self) -> None:
        check_at_least(self, seeds=1, frames=20, maps=0)


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure all maps, write the JSON and return its content."""
    row: Rows = {arguments.without: Row(partial(measured, without=arguments.without), code=_ROW_CODE)}
    folder = arguments.runs / "camera" / "results"
    plan = [(drive, row) for drive in _drives(arguments)]
    asked = [(drive, row) for drive, _ in plan if any(word in drive.name for word in arguments.named or ("",))]
    if not asked:
        raise ValueError(
            f"named is {', '.join(arguments.named)}; expected among {', '.join(of.name for of, _ in plan)}"
        )
    measure(asked, folder, f"camera {arguments.places} {arguments.split}")
    known = {name: of[arguments.without] for name, of in measure(plan, folder, known_only=True).items() if of}
    drives: _Drives = {name: {key: float(value[0]) for key, value in of.errors.items()} for name, of in known.items()}
    split = "" if arguments.split == "test" else f".{arguments.split}"
    ablation = "" if arguments.without == "nothing" else f".no_{arguments.without}"
    places = "" if arguments.places == "doom" else f".{arguments.places}"
    path = arguments.results / f"camera{places}{split}{ablation}.json"
    published = json.loads(path.read_text()) if path.is_file() else None
    if published is not None and published["arguments"]["frames"] == arguments.frames:
        drives = with_earlier(drives, published["drives"], published["revision"])
    result = {
        **records.record("results_camera", arguments),
        "odometry": asdict(CameraConfig()),
        "graph": asdict(PictureGraphConfig()),
        "drives": drives,
        "median": _medians(drives),
        "tables": {arguments.places: _rows(list(drives.values()))},
    }
    records.write_at_once(path, json.dumps(result, indent=1, default=str) + "\n")
    for name, numbers in {**drives, f"median, {len(drives)} drives": result["median"]}.items():
        print(name, {key: value if key == "revision" else round(value, 3) for key, value in numbers.items()})
    return result


def _drives(arguments: Arguments) -> list[Drive]:
    drives = []
    first, frames = _FIRST_SEED[arguments.split], arguments.frames
    seeds = range(first, first + arguments.seeds)
    if arguments.places != "doom":
        make_one, code = (room_drive, _ROOM_CODE) if arguments.places == "rooms" else (maze_drive, _DRIVE_CODE)
        name = arguments.places.removesuffix("s")
        return [
            Drive(f"{name} {seed}", f"{name} {seed}, {frames} frames", partial(make_one, seed, frames), code)
            for seed in seeds
        ]
    for number, of in enumerate(_MAPS[arguments.split][: arguments.maps or None]):
        for seed in seeds:
            name = f"{of[0].removesuffix('.wad')} {of[1]} {seed}"
            make = partial(camera_drive, of, seed, frames, wheels_seed=seed + 100 * number)
            drives.append(Drive(name, f"{name}, {frames} frames, wheels {seed + 100 * number}", make, _DRIVE_CODE))
    return drives


def _rows(drives: list[dict[str, Any]]) -> dict[str, Numbers]:
    """Means over drives, with intervals of 95 %, of what was given, of the odometry, and of the corrected path."""

    def mean(key: str, of: str = "") -> dict[str, Any]:
        return interval_of(np.array([one[key] / (one[of] if of else 1.0) for one in drives]))

    rows = {
        row: {
            **{name: mean(f"{row}_{name}") for name in ("ate_m", "final_percent")},
            "ate_share": mean(f"{row}_ate_m", "given_ate_m"),
        }
        for row in ("given", "odometry", "corrected")
    }
    rows["corrected"] |= {name: mean(name) for name in ("within_3_std", "frames_a_second")}
    return rows


def _medians(drives: _Drives) -> dict[str, float]:
    """Medians of all numbers, and of the share of the given error that is left: the worst of a drive, and of a place,
    whose errors are means over its drives."""
    numbers, places = list(drives.values()), {name.rpartition(" ")[0] for name in drives}
    names = [name for name in numbers[0] if name != "revision"]

    def share(of: list[dict[str, Any]]) -> float:
        return sum(one["corrected_ate_m"] for one in of) / sum(one["given_ate_m"] for one in of)

    shares = [share([one]) for one in numbers]
    of_places = [share([one for name, one in drives.items() if name.rpartition(" ")[0] == place]) for place in places]
    return {
        **{name: float(np.median([one[name] for one in numbers])) for name in names},
        "corrected_share": float(np.median(shares)),
        "worst_share": max(shares),
        "worst_place_share": max(of_places),
    }


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
