"""A calibrated camera without training, from a recording to the corrected path; and what it cannot use, in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import CameraModel
from ngo_estimator.nodes.run_recording import Arguments, run
from ngo_estimator.offline.camera_run import CameraRun
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from ngo_estimator.trajectory.files import read_tum
from ngo_recordings.frames import Frame
from ngo_recordings.scan_stream import WheelPose
from ngo_recordings.topics import TopicArguments
from tests.unit.ngo_estimator.rendered_room import by_wheels, camera, drive, picture, rays_of
from tests.unit.ngo_recordings import messages as m
from training.scoring.metrics import absolute_error_m, path_length_m

BEGIN_NS, PERIOD_NS = 1_000_000_000_000, 100_000_000
FRAME = "camera_optical_frame"


def camera_info(model: CameraModel, matrix: np.ndarray | None = None) -> Any:
    k = (model.matrix if matrix is None else matrix).ravel()
    roi = m.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    rest = (model.distortion, model.coefficients, k, np.eye(3).ravel(), np.zeros(12), 0, 0, roi)
    return m.make("sensor_msgs/msg/CameraInfo", m.header(BEGIN_NS, FRAME), model.height, model.width, *rest)


def mounting(model: CameraModel) -> Any:
    x, y, z, w = Rotation.from_matrix(model.base_from_camera[:, :3]).as_quat()
    at = m.make("geometry_msgs/msg/Pose", m.make("geometry_msgs/msg/Point", *model.centre),
                m.make("geometry_msgs/msg/Quaternion", x, y, z, w))  # fmt: skip
    return m.transforms(m.transform(BEGIN_NS, "base_link", FRAME, at))


def odometry(stamp_ns: int, pose: np.ndarray) -> Any:
    message = m.odometry(stamp_ns, m.pose(*pose.tolist()), m.twist(0.0, 0.0, 0.0))
    message.header.frame_id = "odom"
    return message


def recording(
    path: Path, frames: int, model: CameraModel, info: Any | None, wheels: bool = True, mounted: bool = True
) -> np.ndarray:
    """A drive round the room; returns the true poses ``(frames, 3)`` from the first on."""
    truth, rays, entries = drive(frames), rays_of(model), []
    counted = by_wheels(truth)
    if mounted:
        entries.append(("/tf_static", BEGIN_NS, mounting(model)))
    if info is not None:
        entries.append(("/camera/camera_info", BEGIN_NS, info))
    for k, pose in enumerate(truth):
        stamp_ns = BEGIN_NS + k * PERIOD_NS
        if wheels:
            entries.append(("/odom", stamp_ns, odometry(stamp_ns, counted[k])))
        image = m.image(stamp_ns, picture(model, rays, pose), "mono8")
        image.header.frame_id = FRAME
        entries.append(("/camera/image_raw", stamp_ns, image))
    m.write_mcap(path, entries)
    return np.asarray(se2.between(truth[:1], truth))


def test_a_recording_needs_no_weights_and_comes_out_better_than_its_wheels(tmp_path: Path) -> None:
    model = camera(240)
    truth = recording(tmp_path / "drive.mcap", 72, model, camera_info(model))
    console = Console(record=True, width=200)
    result = run(Arguments((tmp_path / "drive.mcap",), tmp_path / "out"), console)
    said = console.export_text()
    assert "using images /camera/image_raw, wheels /odom, calibration /camera/camera_info" in said
    assert f"{FRAME} in base_link" in said and "plumb_bob" in said
    assert result["weights"] == "camera" and result["faults"] == 0 and not any(result["not_used"].values())
    wheels = absolute_error_m(by_wheels(drive(72)), truth)
    found = {name: read_tum(tmp_path / "out" / f"{name}.tum") for name in ("odometry", "corrected")}
    errors = {name: absolute_error_m(poses.planar(), truth) for name, poses in found.items()}
    assert errors["odometry"] < 0.3 * wheels and errors["corrected"] < 0.2 * wheels
    graph = (tmp_path / "out" / "graph.g2o").read_text()
    assert graph.count("EDGE_SE2") > graph.count("VERTEX_SE2") - 1  # a loop
    assert json.loads((tmp_path / "out" / "run.json").read_text())["frames"] == 72


def test_a_saved_trajectory_goes_on_as_the_one_that_was_saved() -> None:
    model, truth = camera(160), drive(40)
    rays, wheels = rays_of(model), by_wheels(truth)
    odometry_of, online = PictureOdometry(model), PictureTrajectory()
    steps: list[RelativeStep] = []
    for k, pose in enumerate(truth):
        odometry_of.add_wheels(k * PERIOD_NS, wheels[k])
        colours = 3 if k % 2 else 1  # grey as red, green and blue is the same picture
        odometry_of.add_picture(k * PERIOD_NS, np.repeat(picture(model, rays, pose), colours, axis=2))
        steps += odometry_of.ready()
    for step in steps[:25]:
        online.update(step)
    other = PictureTrajectory().restored(online.state())
    for step in steps[25:]:
        np.testing.assert_array_equal(online.update(step).pose_xyyaw, other.update(step).pose_xyyaw)


def test_each_part_of_a_recording_whose_stamps_jump_back_has_wheels_of_its_own() -> None:
    black, late = np.zeros((120, 160, 1), np.uint8), WheelPose(0, np.zeros(3))
    first, second = (
        [WheelPose(k * PERIOD_NS, np.array((at_m + 0.01 * k, 0.0, 0.0))) for k in range(20)] for at_m in (0.0, 100.0)
    )
    run = CameraRun(PictureOdometry(camera(160)), PictureTrajectory())
    frames = [Frame(k * PERIOD_NS, black) for _ in range(2) for k in range(15)]
    events = list(run.run(frames, [*first[:15], late, *first[15:], *second]))
    steps = [event.local for event in events if isinstance(event, RecordedStep)]
    at_m = [float(step.tf_odom_xyyaw[0]) for step in steps]
    np.testing.assert_allclose(at_m, [base + 0.01 * k for base in (0.0, 100.0) for k in range(1, 15)], atol=1e-9)
    assert sum(isinstance(event, RecordedRun) for event in events) == 2
    assert run.remarks() == ["28 of 28 pictures told too little: the robot's odometry alone counts there"]


def test_a_clock_that_is_wrong_is_said_in_one_line() -> None:
    frames = [Frame(30_000_000_000 + k * PERIOD_NS, np.zeros((120, 160, 1), np.uint8)) for k in range(5)]
    run = CameraRun(PictureOdometry(camera(160)), PictureTrajectory())
    assert not list(run.run(frames, [WheelPose(k * PERIOD_NS, np.zeros(3)) for k in range(5)]))
    assert run.rejected == {"no odometry at their stamps": 5}
    assert run.examples.popitem()[1] == "newest stamp of pictures 30.400 s, of odometry 0.400 s"


@pytest.mark.parametrize(
    ("info", "wheels", "width", "world", "complaint"),
    [
        (False, True, 160, "camera", "no CameraInfo is on /camera/camera_info"),
        (False, True, 160, None, "no CameraInfo with pictures"),
        (True, False, 160, None, "no transform says how high the camera is over the floor .found 0 m; expected"),
        (True, True, 80, None, "pictures are 80 x 60; expected a width of 160 or more"),
    ],
)
def test_what_is_missing_is_said_in_one_line(
    tmp_path: Path, info: bool, wheels: bool, width: int, world: str | None, complaint: str
) -> None:
    model = camera(width)
    recording(tmp_path / "drive.mcap", 2, model, camera_info(model) if info else None, wheels, mounted=wheels)
    with pytest.raises(ValueError, match=complaint):
        run(Arguments((tmp_path / "drive.mcap",), tmp_path / "out", world=world), Console(quiet=True))


@pytest.mark.parametrize("wheels", [None, "none"])
def test_odometry_that_is_to_be_named_is_said(tmp_path: Path, wheels: str | None) -> None:
    model, console = camera(160), Console(record=True, width=200)
    recording(tmp_path / "drive.mcap", 2, model, camera_info(model), wheels=False, mounted=False)
    twist = m.make("geometry_msgs/msg/TwistStamped", m.header(BEGIN_NS, "base_link"), m.twist(1.0, 0.0, 0.0))
    m.write_mcap(tmp_path / "more.mcap", [("/encoders", BEGIN_NS, twist)])
    paths = tmp_path / "drive.mcap", tmp_path / "more.mcap"
    with pytest.raises(ValueError, match="no transform says how high"):
        run(Arguments(paths, tmp_path / "out", topics=TopicArguments(wheels=wheels)), console)
    assert ("if it is /encoders, --wheels names it" in console.export_text()) == (wheels is None)


def test_a_camera_that_nobody_calibrated_is_refused(tmp_path: Path) -> None:
    model = camera(160)
    recording(tmp_path / "drive.mcap", 2, model, camera_info(model, np.zeros((3, 3))))
    with pytest.raises(ValueError, match="/camera/camera_info says that the camera is not calibrated"):
        run(Arguments((tmp_path / "drive.mcap",), tmp_path / "out"), Console(quiet=True))


def test_without_wheels_the_floor_gives_the_scale(tmp_path: Path) -> None:
    model, console = camera(240), Console(record=True, width=200)
    truth = recording(tmp_path / "drive.mcap", 20, model, camera_info(model))
    arguments = Arguments((tmp_path / "drive.mcap",), tmp_path / "out", topics=TopicArguments(wheels="none"))
    result = run(arguments, console)
    assert "the scale comes from the camera's height of 0.900 m over the floor" in console.export_text()
    assert result["without_floor"] == result["by_odometry_alone"] == 0
    found = read_tum(tmp_path / "out" / "corrected.tum").planar()
    assert absolute_error_m(found, truth) < 0.05 * path_length_m(truth)
