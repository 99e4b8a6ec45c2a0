"""Recordings as training data: what is read, what is for what, and what is said of those that cannot be used."""

import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from ngo_estimator.checkpoint import LOCAL, load_local, save_checkpoint, write_untrained
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.observations import observation
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_recordings.errors import RecordingError
from ngo_recordings.frames import Frame
from ngo_recordings.images import ScanGeometry
from ngo_recordings.topics import TopicArguments
from tests.unit.ngo_recordings import messages as m
from tests.unit.training import drives
from training import evaluate, featurise, train_familiarity, train_local, train_optimizer, train_place, train_smoother
from training.common import records
from training.recordings import recording_source
from training.recordings.recording_source import RecordedArguments, TrainedLocal, open_recorded, trained_local
from training.recordings.recording_store import MOST_RAYS, format_of, make_store
from training.recordings.recording_tracks import PARTS

FRAMES = 900


@pytest.fixture(autouse=True)
def forget() -> None:
    """Each test reads its files itself."""
    recording_source._opened.cache_clear()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("drives")
    paths = [folder / f"drive_{k}.mcap" for k in range(5)]
    for k, path in enumerate(paths):
        drives.write(path, FRAMES, seed=k)
    return paths


def test_frames_motion_and_scale_are_those_of_the_recordings(files: list[Path], tmp_path: Path) -> None:
    data = open_recorded(RecordedArguments(data=tuple(files[:2])), tmp_path)
    stored, truth = data.recordings[0], drives.poses(FRAMES, 0)
    assert stored.images.shape == (FRAMES, *drives.SHAPE) and len(stored.stamps_ns) == FRAMES
    np.testing.assert_array_equal(stored.images[7], drives.picture(7, 0))
    np.testing.assert_allclose(stored.poses_xyyaw, truth, atol=1e-6)
    np.testing.assert_allclose(stored.residuals, [[drives.HEIGHT_M, 0.0, 0.0]] * FRAMES, atol=1e-6)
    assert data.domain.period_s == pytest.approx(drives.PERIOD_S)
    assert (data.domain.actions, data.domain.twist) == (0, False)
    assert data.domain.place_radius_m == pytest.approx(4.0 * drives.STEP_M, rel=0.05)
    assert data.residual == {"height_range_m": pytest.approx(0.0), "largest_tilt_deg": pytest.approx(0.0)}


@pytest.mark.parametrize("count", [1, 3, 5])
def test_no_frame_is_in_two_parts_and_borders_have_a_gap(files: list[Path], tmp_path: Path, count: int) -> None:
    data = open_recorded(RecordedArguments(data=tuple(files[:count])), tmp_path)
    used: dict[tuple[int, int], str] = {}
    for part in PARTS:
        assert data.tracks(part)
        for track in data.tracks(part):
            for frame in range(track.first, track.first + len(track)):
                assert (track.recording, frame) not in used
                used[track.recording, frame] = part
    for (recording, frame), part in used.items():
        for later in range(1, round(1.9 / drives.PERIOD_S)):
            assert used.get((recording, frame + later), part) == part
    if count > 1:
        assert {number for (number, _), part in used.items() if part == "test"} == {count - 1}
    if count == 5:  # whole recordings
        assert len(used) == 5 * FRAMES


def test_a_track_ends_where_frames_or_true_poses_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    drives.write(path, FRAMES, seed=0, without_frames=range(100, 110), without_poses=range(300, 320))
    data = open_recorded(RecordedArguments(data=(path,)), tmp_path)
    first = [track for track in data.tracks("train") if track.recording == 0]
    assert (first[0].first, len(first[0])) == (0, 100)
    assert first[1].first == 100 and len(first[1]) < 205
    for track in first:
        steps_s = np.diff(track.stamps_ns) / 1e9
        assert np.isfinite(track.poses_xyyaw).all() and steps_s.max() < 1.5 * drives.PERIOD_S


def test_what_was_read_is_kept_and_read_anew_when_a_file_changes(files: list[Path], tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(files[0].read_bytes())
    store = tmp_path / "store"
    _, _, before = make_store(store, (path,), TopicArguments(), None, None)
    made = (store / "0" / "images.raw").stat().st_mtime_ns
    assert make_store(store, (path,), TopicArguments(), None, None)[2] == before
    assert (store / "0" / "images.raw").stat().st_mtime_ns == made
    drives.write(path, FRAMES, seed=1)
    _, (stored,), after = make_store(store, (path,), TopicArguments(), None, None)
    assert after != before
    np.testing.assert_array_equal(stored.images[7], drives.picture(7, 1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 150}, "too short"),
        ({"step_m": 0.0}, "stands still"),
        ({"truth_topic": "/odom"}, r"has no ground truth.*--ground-truth"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    drives.write(path, **{"frames": FRAMES, "seed": 0, **changes})  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match=message) as raised:
        open_recorded(RecordedArguments(data=(path,)), tmp_path)
    assert "\n" not in str(raised.value)


def test_the_format_follows_the_sensor() -> None:
    def of(shape: tuple[int, ...], dtype: str, reduction: int | None = None) -> ImageFormat:
        return format_of(Frame(0, np.zeros(shape, dtype)), reduction)

    assert of((60, 80, 3), "uint8") == ImageFormat(60, 80, 3, "uint8")
    assert of((480, 640, 1), "uint8") == ImageFormat(68, 91, 1, "uint8", reduction=7)
    assert of((480, 640, 3), "uint8", 8) == ImageFormat(60, 80, 3, "uint8", reduction=8)
    assert of((1, 241, 4), "float32") == ImageFormat(1, 241, 4, "float32")
    half = ScanGeometry(-np.pi / 2, np.pi / 180, 0.1, 10.0)
    scan = format_of(Frame(0, np.ones((1, 181, 1), np.float32), half), None)
    assert scan.shape == (1, 181, 1) and scan.field_of_view_deg == pytest.approx(180.0)
    whole = ScanGeometry(-np.pi, np.pi / 180, 0.1, 10.0)
    assert format_of(Frame(0, np.ones((1, 360, 1), np.float32), whole), None).field_of_view_deg == 360.0


def test_a_scanner_that_looks_to_one_side_keeps_all_its_rays() -> None:
    ranges = np.linspace(1.0, 2.0, 181, dtype=np.float32)[None, :, None]  # leftmost ray first
    left_half = Frame(0, ranges, ScanGeometry(0.0, np.pi / 180, 0.1, 10.0))
    image = format_of(left_half, None)
    assert image.field_of_view_deg == pytest.approx(360.0) and image.width == MOST_RAYS
    seen = observation(image, left_half.image, left_half.scan)
    assert seen[np.isfinite(seen)].min() == 1.0 and seen[np.isfinite(seen)].max() == 2.0
    turned = math.radians(-90.0)  # mounted so that the middle of its view is straight ahead
    image = format_of(left_half, None, turned)
    assert image.field_of_view_deg == pytest.approx(180.0) and image.width == 181
    np.testing.assert_allclose(observation(image, left_half.image, left_half.scan, turned), ranges, atol=1e-6)


def test_actions_that_no_network_knows_are_refused(tmp_path: Path) -> None:
    entries: list[m.Entry] = []
    for k in range(FRAMES):
        at = m.odometry(k * 10**8, m.pose(0.1 * k, 0.0, 0.0), m.twist(1.0, 0.0, 0.0))
        entries.append(("/ground_truth", k * 10**8, at))
        entries.append(("/image", k * 10**8, m.image(k * 10**8, drives.picture(k, 0))))
        entries.append(("/action", k * 10**8, m.action(k * 10**8, 3)))
    path = m.write_mcap(tmp_path / "drive.mcap", entries)
    with pytest.raises(RecordingError, match=r"/action holds action 3; expected 0 to 2: .*--action none"):
        open_recorded(RecordedArguments(data=(path,)), tmp_path)


def local_of(given: RecordedArguments, folder: Path, **changes: Any) -> TrainedLocal:
    """A local network as ``train_local`` leaves it after learning from recordings."""
    data = open_recorded(given, folder / "runs")
    domain = data.domain
    config = LocalPoseConfig(
        **{
            "image": domain.image,
            "width": 0.03,
            "actions": domain.actions,
            "period_s": domain.period_s,
            "mirrored_actions": domain.mirrored_actions,
            **changes,
        }
    )
    training = records.record("train_local", train_local.Arguments(recordings=given))
    training["arguments"]["data_sha256"] = data.sha256
    path = folder / "weights" / given.name / f"{LOCAL}.safetensors"
    save_checkpoint(path, LocalPoseNetwork(config), LOCAL, given.name, {"training": training})
    return load_local(path.parent)


def test_the_data_of_the_local_network_are_taken_and_no_others(files: list[Path], tmp_path: Path) -> None:
    given = RecordedArguments(data=tuple(files[:2]), scan_yaw_deg=3.0, topics=TopicArguments(image="/image"))
    assert trained_local(tmp_path / "weights", given.name) is None
    local = local_of(given, tmp_path)
    assert open_recorded(given, tmp_path / "runs", local).sha256
    read = (tmp_path / "runs" / given.name / "data" / "store.json").read_bytes()
    for changed, message in (
        (
            replace(given, topics=TopicArguments()),
            r"given --image left out; expected --image /image: give",
        ),
        (replace(given, topics=TopicArguments(image="/scan")), r"given --image /scan; expected --image /image"),
        (replace(given, scan_yaw_deg=0.0), r"given --scan-yaw-deg 0\.0; expected --scan-yaw-deg 3\.0"),
        (replace(given, data=(files[0],)), r"given --data drive_0\.mcap; expected --data drive_0\.mcap drive_1\.mcap"),
        (replace(given, holdout=(files[0],)), r"given --holdout drive_0\.mcap; expected --holdout left out"),
    ):
        with pytest.raises(RecordingError, match=message) as raised:
            open_recorded(changed, tmp_path / "runs", local)
        assert "\n" not in str(raised.value)
    # Nothing was read for it.
    assert (tmp_path / "runs" / given.name / "data" / "store.json").read_bytes() == read
    # What does not concern the local network may differ.
    open_recorded(replace(given, place_radius_m=0.7), tmp_path / "runs", local)


def test_a_local_network_that_takes_other_frames_or_is_told_other_things_is_refused(
    files: list[Path], tmp_path: Path
) -> None:
    given = RecordedArguments(data=tuple(files[:2]))
    other = local_of(given, tmp_path, image=ImageFormat(12, 16, 1, "uint8"))
    with pytest.raises(RecordingError, match=r"takes ImageFormat.*channels=1.*these recordings give .*channels=3"):
        open_recorded(given, tmp_path / "runs", other)
    told = local_of(given, tmp_path, actions=3, mirrored_actions=(0, 2, 1))
    with pytest.raises(RecordingError, match=r"and actions; these recordings give .* and images alone"):
        open_recorded(given, tmp_path / "runs", told)


def test_recordings_that_changed_since_are_refused(files: list[Path], tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(files[0].read_bytes())
    given = RecordedArguments(data=(path,))
    local = local_of(given, tmp_path)
    recording_source._opened.cache_clear()
    drives.write(path, FRAMES, seed=1)
    with pytest.raises(RecordingError, match="are not those that its local network learned from"):
        open_recorded(given, tmp_path / "runs", local)
    untrained = (local[0], {"world": given.name})
    with pytest.raises(RecordingError, match="was not trained on recordings"):
        open_recorded(given, tmp_path / "runs", untrained)


SCRIPTS: list[tuple[ModuleType, dict[str, str]]] = [
    (train_place, {"out": "weights", "runs": "runs"}),
    (train_familiarity, {"weights": "weights", "out": "runs"}),
    (featurise, {"weights": "weights", "out": "runs"}),
    (train_smoother, {"weights": "weights", "out": "weights", "runs": "runs"}),
    (train_optimizer, {"weights": "weights", "out": "weights", "runs": "runs"}),
    (evaluate, {"weights": "weights", "runs": "runs"}),
]


@pytest.mark.parametrize(("script", "folders"), SCRIPTS, ids=lambda value: getattr(value, "__name__", ""))
def test_every_script_of_a_training_compares(
    script: Any, folders: dict[str, str], files: list[Path], tmp_path: Path
) -> None:
    given = RecordedArguments(data=tuple(files[:2]), topics=TopicArguments(image="/image"))
    local_of(given, tmp_path)
    if script in (featurise, train_familiarity):
        write_untrained(tmp_path / "place", given.name, ImageFormat(*drives.SHAPE, "uint8"))
        for path in (tmp_path / "place").glob("place_encoder.*"):
            path.rename(tmp_path / "weights" / given.name / path.name)
    places = {name: tmp_path / folder for name, folder in folders.items()}
    forgotten = script.Arguments(recordings=replace(given, topics=TopicArguments()), **places)
    with pytest.raises(RecordingError, match="given --image left out; expected --image /image"):
        script.main(forgotten)
