"""How good ``world:=camera`` is on Doom maps: odometry and loops from pictures of 640 x 480, without training.

    python -m training.results --world camera --split validation
    python -m training.results --world camera
    python -m training.results --world camera --named take_cover MAP27
    python -m training.results --world camera --split validation --without corrector

Drives that ``camera.json`` has of the same revision and settings are not measured again.

A drive of the explorer on each map. The motion given is that of wheels with errors (``given_motion``). The command
prints a table and writes ``training/results/camera.json``: each drive, and rows with means over drives.
"""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ngo_common.files import write_whole
from ngo_estimator.frontend.camera.camera_config import CameraConfig
from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import CameraModel, tilted
from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem
from ngo_estimator.loops.picture_settings import PictureGraphConfig
from ngo_estimator.slam.picture_back_end import PictureBackEnd
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from ngo_sim.episodes import record_episode
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from training.baselines.graph_peers import least_squares
from training.common import records
from training.common.command_line import check_at_least, run_command
from training.data.doom_drives import TEST_MAPS, VALIDATION_MAPS, Map
from training.scoring.metrics import absolute_error_m, path_length_m, trajectory_error, within
from training.scoring.statistics import mean_interval

_MAPS = {"validation": VALIDATION_MAPS, "test": TEST_MAPS}
_FIRST_SEED = {"validation": 10_000, "test": 20_000}
_EYE_M = 0.8
_ROWS = ("given", "odometry", "corrected")
_WRONG_M, _WRONG_RAD = 0.5, np.radians(5.0)
"""A loop that is off by more is wrong."""


@dataclass(frozen=True)
class Arguments:
    """Settings of the measurement."""

    world: Literal["camera"] = "camera"  # World to measure in.
    split: Literal["validation", "test"] = "test"  # Maps to measure on; settings are chosen on validation.
    seeds: int = 1  # Drives of each map.
    frames: int = 1000  # Frames of a drive.
    maps: int = 0  # Number of maps; 0: all.
    without: Literal["nothing", "tracks", "sift", "corrector"] = "nothing"  # An ablation, in a file of its own.
    named: tuple[str, ...] = ()  # Words of which one is in the name of each map to measure, as take_cover; none: all.
    results: Path = Path("training/results")  # Folder of camera.json.

    def __post_init__(self) -> None:
        check_at_least(self, seeds=1, frames=20, maps=0)


@dataclass(frozen=True)
class Drive:
    """Grey pictures of a drive, its true poses ``(frames, 3)`` from the first on, and the camera."""

    pictures: list[np.ndarray]
    truth: np.ndarray
    camera: CameraModel
    period_s: float


def drive(of: Map, seed: int, frames: int) -> Drive:
    """A drive of the explorer on a map."""
    config = Maze3DConfig(wad=of[0], map=of[1], width=320, height=240)
    world, pictures = Maze3D(config, render_mode="rgb_array"), []

    def watch(world: Maze3D, _: np.ndarray) -> None:
        picture = world.render()
        assert picture is not None
        pictures.append(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))

    try:
        poses = record_episode(world, "explorer", frames, seed, watch=watch).poses_xyyaw
    finally:
        world.close()
    across, down = (2.0 * focal for focal in config.focal_lengths_px)
    matrix = np.array(((across, 0.0, 319.5), (0.0, down, 239.5), (0.0, 0.0, 1.0)))
    camera = CameraModel(640, 480, matrix, "plumb_bob", np.zeros(0), tilted(0.0, _EYE_M))
    return Drive(pictures, se2.between(poses[:1], poses), camera, config.period_s)


def given_motion(truth: np.ndarray, seed: int) -> np.ndarray:
    """Poses ``(frames, 3)`` by wheels that nobody calibrated, for true ones from the origin on.

    For the whole drive they count way and turn wrong by shares (1 % and 2 %, deviations of the drives) and turn with
    the way (0.02 rad/m). In each step noise grows with the root of the way (0.015 m and 0.02 rad at 1 m) and with the
    turn (3 %).
    """
    rng, steps = np.random.default_rng([seed, 48]), se2.between(truth[:-1], truth[1:])
    way = np.hypot(steps[:, 0], steps[:, 1])
    share, turn, drift = 1.0 + rng.normal(0.0, 0.01), 1.0 + rng.normal(0.0, 0.02), rng.normal(0.0, 0.02)
    noise = rng.standard_normal((len(steps), 3)) * np.sqrt(way)[:, None] * (0.015, 0.015, 0.02)
    counted = steps * (share, share, turn) + noise
    counted[:, 2] += drift * way + rng.standard_normal(len(steps)) * 0.03 * np.abs(steps[:, 2])
    poses = np.zeros((len(truth), 3))
    for frame, step in enumerate(counted):
        poses[frame + 1] = se2.compose(poses[frame], step)
    return poses


class _Orb:
    """A ``Describer``: ORB (Rublee et al. 2011), each bit a number."""

    def __init__(self, most: int) -> None:
        self._orb = cv2.ORB.create(nfeatures=most)

    def describe(self, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found, codes = self._orb.detectAndCompute(grey, None)
        if len(found) == 0:
            return np.zeros((0, 2)), np.zeros(0), np.zeros((0, 256), np.float32)
        bits = np.unpackbits(np.asarray(codes, np.uint8), axis=1).astype(np.float32)
        std = 0.5 * 1.2 ** np.array([point.octave for point in found])  # pixels of its level of the pyramid
        return np.array([point.pt for point in found]), std, (bits - 0.5) / 8.0


class _Believes:
    """A ``Corrector`` that believes all loops."""

    def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
        loops, steps = np.ones(len(problem.loops)), np.ones(len(problem.steps))
        return CorrectedGraph(problem, least_squares(problem), loops, steps, 0.0)


class _BelievingTrajectory(PictureTrajectory):
    def _new_back_end(self) -> PictureBackEnd:
        back_end = super()._new_back_end()
        back_end._corrector = _Believes()
        return back_end


def estimators(camera: CameraModel, without: str) -> tuple[PictureOdometry, PictureTrajectory]:
    """Both estimators, without their tracked corners, SIFT (ORB stands for it) or the robust corrector."""
    config = CameraConfig(least_inliers=CameraConfig.corners + 1) if without == "tracks" else CameraConfig()
    odometry = PictureOdometry(camera, config, _Orb(config.features) if without == "sift" else None)
    return odometry, _BelievingTrajectory() if without == "corrector" else PictureTrajectory()


def measured(of: Drive, given: np.ndarray, without: str = "nothing") -> dict[str, float]:
    """All numbers of one drive."""
    odometry, graph = estimators(of.camera, without)
    published, covariances = [], []
    began = time.process_time()  # of one thread, whatever else runs on the machine
    for frame, picture in enumerate(of.pictures):
        stamp_ns = round(frame * of.period_s * 1e9)
        odometry.add_wheels(stamp_ns, given[frame])
        odometry.add_picture(stamp_ns, picture[..., None])
        for step in odometry.ready():
            update = graph.update(step)
            published.append(update.pose_xyyaw)
            covariances.append(update.covariance)
    graph.finish()
    took_s = time.process_time() - began
    found = graph.trajectory()
    assert found is not None
    truth, relative = of.truth, se2.between(of.truth[found.loops[:, 0]], of.truth[found.loops[:, 1]])
    off = se2.wrapped(found.loop_relative_xyyaw - relative)
    wrong = (np.hypot(off[:, 0], off[:, 1]) > _WRONG_M) | (np.abs(off[:, 2]) > _WRONG_RAD)
    believed = found.loop_weights > 0.5
    turned = [se2.wrapped(se2.between(poses[:-10], poses[10:]) - se2.between(truth[:-10], truth[10:]))[:, 2]
              for poses in (given, found.odometry_xyyaw)]  # fmt: skip
    return {
        "path_m": path_length_m(truth),
        "given_ate_m": absolute_error_m(given, truth),
        "odometry_ate_m": absolute_error_m(found.odometry_xyyaw, truth),
        "corrected_ate_m": absolute_error_m(found.poses_xyyaw, truth),
        "given_final_percent": trajectory_error(given, truth).final_percent,
        "odometry_final_percent": trajectory_error(found.odometry_xyyaw, truth).final_percent,
        "corrected_final_percent": trajectory_error(found.poses_xyyaw, truth).final_percent,
        "given_turn_deg": float(np.degrees(np.median(np.abs(turned[0])))),
        "odometry_turn_deg": float(np.degrees(np.median(np.abs(turned[1])))),
        "within_3_std": within(np.array(published), np.array(covariances), truth[1:]),
        "loops": len(off),
        "believed": int(believed.sum()),
        "wrong": int(wrong.sum()),
        "wrong_believed": int((wrong & believed).sum()),
        "by_wheels": odometry.by_wheels / max(1, odometry.frames),
        "frames_a_second": len(of.pictures) / took_s,
    }


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure all maps, write the JSON and return its content."""
    cv2.setNumThreads(1)
    result: dict[str, Any] = {
        **records.record("results_camera", arguments),
        "odometry": asdict(CameraConfig()),
        "graph": asdict(PictureGraphConfig()),
        "drives": {},
    }
    named = {"test": "", "nothing": ""}
    parts = [named.get(part, f".{part}") for part in (arguments.split, arguments.without)]
    path = arguments.results / f"camera{parts[0]}{parts[1].replace('.', '.no_')}.json"
    result["drives"] = _measured_before(path, result)
    first = _FIRST_SEED[arguments.split]
    for number, of in enumerate(_MAPS[arguments.split][: arguments.maps or None]):
        for seed in range(first, first + arguments.seeds):
            title = f"{of[0].removesuffix('.wad')} {of[1]} {seed}"
            if title in result["drives"] or not any(word in title for word in arguments.named or ("",)):
                continue
            one = drive(of, seed, arguments.frames)
            result["drives"][title] = measured(one, given_motion(one.truth, seed + 100 * number), arguments.without)
            print(_line(title, result["drives"][title]), flush=True)
            _write(path, result)
    _write(path, result)
    print(_line(f"median, {len(result['drives'])} drives", result["median"]))
    return result


def _write(path: Path, result: dict[str, Any]) -> None:
    """Sum the drives up, and write all."""
    drives = list(result["drives"].values())
    result["median"] = _medians(drives)
    if len(drives) > 1:
        result["tables"] = {"doom": _rows(drives)}
    write_whole(path, json.dumps(result, indent=1, default=str) + "\n")


def _measured_before(path: Path, wanted: dict[str, Any]) -> dict[str, dict[str, float]]:
    """The drives that a file has of this revision, with these settings and as many frames."""
    if not path.exists():
        return {}
    before = json.loads(path.read_text())
    told = json.loads(json.dumps(wanted, default=str))
    same = all(before.get(name) == told[name] for name in ("revision", "odometry", "graph"))
    frames = before["arguments"]["frames"] == wanted["arguments"]["frames"]
    return dict(before["drives"]) if same and frames else {}


def _rows(drives: list[dict[str, float]]) -> dict[str, dict[str, Any]]:
    """Means over drives, with intervals of 95 %, of what was given, of the odometry, and of the corrected path."""

    def mean(values: list[float]) -> dict[str, object]:
        return mean_interval(np.array(values)).as_json()

    names = ("ate_m", "final_percent")
    rows = {}
    for row in _ROWS:
        rows[row] = {name: mean([one[f"{row}_{name}"] for one in drives]) for name in names}
        rows[row]["ate_share"] = mean([one[f"{row}_ate_m"] / one["given_ate_m"] for one in drives])
    rows["corrected"] |= {name: mean([one[name] for one in drives]) for name in ("within_3_std", "frames_a_second")}
    return rows


def _medians(drives: list[dict[str, float]]) -> dict[str, float]:
    medians = {name: float(np.median([one[name] for one in drives])) for name in drives[0]}
    shares = [one["corrected_ate_m"] / one["given_ate_m"] for one in drives]
    return {**medians, "corrected_share": float(np.median(shares)), "worst_share": float(np.max(shares))}


def _line(name: str, of: dict[str, float]) -> str:
    return (
        f"{name:36} path {of['path_m']:4.0f} m, ATE given {of['given_ate_m']:.3f}, "
        f"odometry {of['odometry_ate_m']:.3f}, corrected {of['corrected_ate_m']:.3f} m; "
        f"turn {of['given_turn_deg']:.2f} -> {of['odometry_turn_deg']:.2f} deg; within {of['within_3_std']:.3f}; "
        f"loops {of['believed']:.0f}/{of['loops']:.0f}, wrong {of['wrong_believed']:.0f}/{of['wrong']:.0f}; "
        f"by wheels {of['by_wheels']:.2f}; {of['frames_a_second']:.1f} frames/s"
    )


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
