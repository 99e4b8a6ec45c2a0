"""The table of a calibrated camera at toy size: every number is there, in the file as in the result."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.frontend.camera import tracked_odometry
from ngo_estimator.geometry import planar_views
from ngo_estimator.geometry.view_pose import camera_at
from ngo_estimator.loops import picture_fit
from tests.unit.ngo_estimator.geometry.test_planar_views import MOTION, points, seen
from tests.unit.ngo_estimator.rendered_room import camera
from training import results_camera
from training.scoring import camera_rows
from training.scoring.table import Measured

pytestmark = pytest.mark.slow

SOLVING = (tracked_odometry, picture_fit)

PUBLISHED = dict.fromkeys(
    (f"{row}_{of}" for row in ("given", "odometry", "corrected") for of in ("ate_m", "final_percent")), 1.0
)
PUBLISHED |= {"within_3_std": 1.0, "frames_a_second": 40.0, "loops": 1.0}


@pytest.mark.parametrize("without", ["tracks", "points", "planar", "sift", "corrector", "wheels"])
def test_an_ablation_has_a_file_of_its_own(without: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(results_camera._MAPS, "test", (("take_cover.wad", "MAP01"),))
    (drive,) = results_camera.main(
        results_camera.Arguments(frames=24, without=without, results=tmp_path, runs=tmp_path / "runs")  # type: ignore[arg-type]
    )["drives"].values()
    assert [path.name for path in tmp_path.glob("*.json")] == [f"camera.no_{without}.json"]
    assert ("floorless" in drive) == (without == "wheels")
    assert (drive["odometry_ate_m"] == pytest.approx(drive["given_ate_m"])) == (without == "tracks")
    odometry, graph = camera_rows.estimators(camera(), without)
    with camera_rows.solver(without):
        assert all((module.ransac is camera_rows.five_points) == (without == "planar") for module in SOLVING)
    assert all(module.ransac is planar_views.ransac for module in SOLVING)
    assert isinstance(odometry._describer, camera_rows._Orb) == (without == "sift")
    assert isinstance(graph._new_back_end()._corrector, camera_rows._Believes) == (without == "corrector")


def test_five_points_tell_the_turn_and_the_direction_where_a_fifth_of_the_pairs_is_wrong() -> None:
    first, second, model = seen("plumb_bob", points(60))
    second[:12] = second[12:24]
    found = camera_rows.five_points(first, second, 1e-3, 300)
    assert found is not None
    way = camera_at(MOTION, model.centre) - model.centre
    assert found[0] == pytest.approx((MOTION[2], np.arctan2(way[1], way[0])), abs=1e-3)
    assert found[1][12:].all() and found[1][:12].mean() < 0.5
    assert camera_rows.five_points(first, second, 1e-3, 300, near=(0.0, 0.1)) is None


def test_a_short_drive_on_a_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(results_camera._MAPS, "test", (("take_cover.wad", "MAP01"),))
    arguments = results_camera.Arguments(frames=24, seeds=2, results=tmp_path, runs=tmp_path / "runs")
    result = results_camera.main(arguments)
    monkeypatch.setattr(results_camera, "camera_drive", pytest.fail)
    assert results_camera.main(arguments)["drives"] == result["drives"]  # they are not measured again
    drive, other = result["drives"].values()
    assert all(np.isfinite(value) for value in drive.values()) and drive["path_m"] > 0.0
    assert result["tables"]["doom"]["corrected"]["ate_m"]["mean"] == pytest.approx(
        0.5 * (drive["corrected_ate_m"] + other["corrected_ate_m"])
    )
    assert json.loads((tmp_path / "camera.json").read_text())["median"] == result["median"]
    left, given = ([each[of] for each in (drive, other)] for of in ("corrected_ate_m", "given_ate_m"))
    assert result["median"]["worst_place_share"] == pytest.approx(sum(left) / sum(given))


def test_rooms_of_another_renderer_ask_for_it_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    arguments = results_camera.Arguments(places="rooms", frames=24, results=tmp_path, runs=tmp_path / "runs")
    with pytest.raises(ValueError, match=r"^pybullet is not installed; expected .* before$"):
        results_camera.main(arguments)


def test_a_short_drive_through_a_room(tmp_path: Path) -> None:
    pytest.importorskip("pybullet", reason="another renderer, which is no requirement")
    arguments = results_camera.Arguments(places="rooms", frames=24, results=tmp_path, runs=tmp_path / "runs")
    result = results_camera.main(arguments)
    assert [path.name for path in tmp_path.glob("*.json")] == ["camera.rooms.json"]
    (drive,) = result["drives"].values()
    assert drive["path_m"] == pytest.approx(23 * 0.07, rel=0.05) and drive["by_wheels"] == 0.0
    assert result["tables"]["rooms"]["odometry"]["ate_m"]["mean"] == drive["odometry_ate_m"] < drive["given_ate_m"]


def test_a_restricted_command_keeps_the_published_drives_that_it_does_not_measure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results_camera, "camera_drive", lambda *_, **__: None)
    monkeypatch.setattr(results_camera, "measured", lambda *_, **__: Measured.of({**PUBLISHED, "loops": 3.0}))
    older, named = dict.fromkeys(("take_cover MAP01 20000", "elsewhere MAP07 20000"), PUBLISHED), ("take_cover",)
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"arguments": {"frames": 24}, "revision": "abc", "drives": older}))
    monkeypatch.setitem(results_camera._MAPS, "test", (("take_cover.wad", "MAP01"), ("elsewhere.wad", "MAP07")))
    for folder in ("runs", "fresh"):  # what the second one finds in the file, it must not call its own
        arguments = results_camera.Arguments(frames=24, named=named, results=tmp_path, runs=tmp_path / folder)
        result = results_camera.main(arguments)
        anew, kept = (result["drives"][name] for name in older)
        assert anew == {**PUBLISHED, "loops": 3.0} and kept == {**PUBLISHED, "revision": "abc"}
        assert result["median"]["loops"] == 2.0
    arguments = results_camera.Arguments(frames=25, named=named, results=tmp_path, runs=tmp_path / "runs")
    assert [*results_camera.main(arguments)["drives"]] == ["take_cover MAP01 20000"]  # others are of other lengths
