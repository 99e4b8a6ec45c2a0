"""The model of a camera from its calibration and its mounting, as messages say them."""

from ngo_estimator.geometry.camera_model import CameraModel, camera_mounting, tilted
from ngo_recordings.calibration import Calibration
from ngo_recordings.poses import Pose
from ngo_recordings.space_scan import is_optical

NOT_MOUNTED = "taken to be at the robot's own place, looking ahead"


def calibrated_camera(calibration: Calibration, mounting: Pose | None) -> CameraModel:
    """The camera, whose frame has a ``mounting`` in the robot's base frame; None: at its own place, looking ahead."""
    place = tilted(0.0, 0.0)
    if mounting is not None:
        axes, optical = mounting.rotation.as_matrix(), is_optical(calibration.frame_id)
        place = camera_mounting(mounting.position, axes, optical)
    return CameraModel(
        calibration.width,
        calibration.height,
        calibration.matrix,
        calibration.distortion,
        calibration.coefficients,
        place,
    )
