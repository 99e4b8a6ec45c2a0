"""The model of a camera from its calibration and its mounting, as messages say them."""

from ngo_estimator.geometry.camera_model import CameraModel, camera_mounting, tilted
from ngo_recordings.calibration import Calibration
from ngo_recordings.poses import Pose

NOT_MOUNTED = "taken to be at the robot's own place, looking ahead"


def calibrated_camera(calibration: Calibration, mounting: Pose | None) -> CameraModel:
    """The camera at its ``mounting`` in the robot's base frame; None: at the robot's own place, looking ahead."""
    place = tilted(0.0, 0.0) if mounting is None else camera_mounting(mounting.position, mounting.rotation.as_matrix())
    return CameraModel(
        calibration.width,
        calibration.height,
        calibration.matrix,
        calibration.distortion,
        calibration.coefficients,
        place,
    )
