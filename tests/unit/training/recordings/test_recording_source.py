"""Recordings as training data: what is read, what is for what, and what is said of those that cannot be used."""

import math
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.observations import observation
from ngo_recordings.errors import RecordingError
from ngo_recordings.frames import Frame
from ngo_recordings.images import ScanGeometry
from ngo_recordings.topics import TopicArguments
from tests.unit.ngo_recordings import messages as m
from tests.unit.training import drives
from training.common.command_line import run_command
from training.common.runs import RunError
from training.recordings import recording_source
from training.recordings.recording_source import RecordedArguments, open_recorded
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


def test_the_holdout_is_the_one_that_is_named(files: list[Path], tmp_path: Path) -> None:
    data = open_recorded(RecordedArguments(data=tuple(files[:3]), holdout=(files[0],)), tmp_path)
    assert {track.recording for track in data.tracks("test")} == {0}
    with pytest.raises(ValueError, match=r"holdout is other\.mcap"):
        RecordedArguments(data=tuple(files[:3]), holdout=(Path("other.mcap"),))


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


def test_a_true_trajectory_that_changes_is_read_anew(files: list[Path], tmp_path: Path) -> None:
    def truth(x: float) -> float:
        file.write_text("".join(f"{1.0 + 0.1 * k:.9f} {x + k} 0 0 0 0 0 1\n" for k in range(FRAMES)))
        given = TopicArguments(ground_truth=str(file))
        _, (stored,), _ = make_store(tmp_path / "store", (files[0],), given, None, None)
        return float(stored.poses_xyyaw[0, 0])

    file = tmp_path / "truth.tum"
    assert (truth(0.0), truth(10.0)) == (0.0, 10.0)


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


def test_a_run_that_does_not_fit_ends_a_script_with_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def main(_: object) -> None:
        raise RunError("the folder holds another run")

    monkeypatch.setattr("sys.argv", ["train_local"])
    with pytest.raises(SystemExit, match=r"^unusable: the folder holds another run$"):
        run_command(main, RecordedArguments, None)
