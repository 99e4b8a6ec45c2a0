"""The table of a calibrated camera at toy size: every number is there, in the file as in the result."""

import json
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.view_pose import camera_at
from ngo_estimator.loops import picture_fit
from tests.unit.ngo_estimator.geometry.test_planar_views import MOTION, points, seen
from tests.unit.ngo_estimator.rendered_room import camera
from training import results_camera
from training.scoring import camera_rows

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("without", ["tracks", "points", "planar", "sift", "corrector"])
def test_an_ablation_has_a_file_of_its_own(without: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(results_camera._MAPS, "test", (("take_cover.wad", "MAP01"),))
    (drive,) = results_camera.main(
        results_camera.Arguments(frames=24, without=without, results=tmp_path, runs=tmp_path / "runs")  # type: ignore[arg-type]
    )["drives"].values()
    assert [path.name for path in tmp_path.glob("*.json")] == [f"camera.no_{without}.json"]
    assert (drive["odometry_ate_m"] == pytest.approx(drive["given_ate_m"])) == (without == "tracks")
    odometry, graph = camera_rows.estimators(camera(), without)
    assert (picture_fit.ransac is camera_rows.five_points) == (without == "planar")
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
