"""A calibrated camera's frames and the robot's odometry to relative steps, with key pictures for loops."""

import math
from collections import deque
from collections.abc import Iterator

import cv2
import numpy as np

from ngo_estimator.data.relative_step import RESTART_AFTER_NS, RelativeStep
from ngo_estimator.frontend.camera.camera_config import CameraConfig
from ngo_estimator.frontend.camera.descriptors import Describer, Sift
from ngo_estimator.frontend.camera.feature_tracks import Grey
from ngo_estimator.frontend.camera.tracked_odometry import TrackedOdometry
from ngo_estimator.frontend.lidar.stamped_wheels import StampedWheels
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame, RejectedFrame
from ngo_estimator.geometry.camera_model import CameraModel
from ngo_estimator.geometry.key_picture import KeyPicture
from ngo_estimator.geometry.planar_motion import between

LEAST_WIDTH = 160
"""Pixels that a picture needs across: in smaller ones too few features are found again."""

SCALELESS = "they have the scale of those before them, or none"
"""Of pictures without the floor, where it tells the scale."""

_MOST_WAITING = 64
_NOTHING = np.zeros(0, np.float32)


def require_usable(model: CameraModel) -> None:
    """Raise ``ValueError`` about a camera whose pictures are too small."""
    if model.width < LEAST_WIDTH:
        raise ValueError(
            f"pictures are {model.width} x {model.height}; expected a width of {LEAST_WIDTH} or more: weights that are "
            "trained on such pictures take smaller ones"
        )


class PictureOdometry:
    """Takes pictures and poses of the robot's odometry by their stamps, and hands on a step for each picture.

    A picture waits for the odometry at its stamp. The first one is the origin.

    Args:
        by_floor: there is no odometry of the robot, and no picture waits for it: the scale comes from the camera's
            height over the floor.
    """

    def __init__(
        self,
        model: CameraModel,
        config: CameraConfig | None = None,
        describer: Describer | None = None,
        by_floor: bool = False,
    ) -> None:
        require_usable(model)
        self.model, self._config, self._by_floor = model, config or CameraConfig(), by_floor
        if by_floor and not model.centre[2] >= self._config.least_height_m:
            raise ValueError(
                "there is no odometry of the robot, and no transform says how high the camera is over the floor "
                f"(found {model.centre[2]:g} m; expected {self._config.least_height_m:g} m or more): the scale comes "
                "from either"
            )
        self._describer = describer or Sift(self._config.features)
        self._odometry = TrackedOdometry(model, self._config, by_floor)
        self.restarts = 0
        """How often stamps jumped back, so that the odometry began anew."""
        self.unplaced = self.jumps = 0
        """Pictures at whose stamps there was no odometry, and motions of it that no robot makes; neither is used."""
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next picture."""
        self._wheels = StampedWheels()
        self._waiting: deque[tuple[int, Grey]] = deque()
        self._odometry.reset()
        self._last_ns: int | None = None
        self._newest_ns: int | None = None
        self._origin_ns = 0
        self._given = np.zeros(3)  # the wheels' pose at the last picture
        self._velocity = np.zeros(3)  # the last one that was given and believed, in base axes
        self._blind_s = 0.0  # since a picture told a way, where there are no wheels
        self._key_pose = np.zeros(3)
        self._origin_code: np.ndarray | None = None
        self.has_wheels = False
        """Whether odometry of the robot came."""
        self.frames = self.by_wheels = 0
        """Frames with a step, and those whose picture told too little: the robot's odometry alone counts there."""
        self.floorless = 0
        """Frames without enough of the floor, where it gives the scale: only ranges remember it there."""

    def add_wheels(self, stamp_ns: int, pose_xyyaw: np.ndarray) -> None:
        """Take a pose ``(3,)`` of the robot's odometry, in its own frame."""
        if not np.isfinite(pose_xyyaw).all():
            raise ValueError("robot odometry has values that are not finite")
        if stamp_ns <= self._wheels.newest_ns - RESTART_AFTER_NS:
            self._wheels = StampedWheels()
        self.has_wheels = True
        self._wheels.add(stamp_ns, pose_xyyaw)

    def add_picture(self, stamp_ns: int, picture: np.ndarray) -> None:
        """Take a picture ``(height, width, channels)`` uint8, grey or red, green and blue.

        Raises:
            RejectedFrame: it is not newer than the last one, or of another size than the calibration.
        """
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            if stamp_ns <= self._newest_ns - RESTART_AFTER_NS:
                self.unplaced += len(self._waiting)
                wheels, had_wheels = self._wheels, self.has_wheels
                self.reset()
                self.restarts += 1
                if wheels.newest_ns < stamp_ns + RESTART_AFTER_NS:  # of the new run already
                    self._wheels, self.has_wheels = wheels, had_wheels
            else:
                kind = DuplicateFrame if stamp_ns == self._newest_ns else LateFrame
                raise kind(f"picture of {stamp_ns} ns came after one of {self._newest_ns} ns")
        if picture.shape[:2] != (self.model.height, self.model.width) or picture.dtype != np.uint8:
            height, width = picture.shape[:2]
            raise RejectedFrame(
                f"the picture is {width} x {height} of {picture.dtype}; expected {self.model.width} x "
                f"{self.model.height} of uint8, as the calibration says"
            )
        self._newest_ns = stamp_ns
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft()
            self.unplaced += 1
        self._waiting.append((stamp_ns, _grey(picture)))

    @property
    def instead(self) -> str:
        """What counts where a picture tells too little, in words."""
        return "the way is a guess there" if self._by_floor else "the robot's odometry alone counts there"

    @property
    def inliers(self) -> int:
        """Corners that agreed with the newest pose."""
        return self._odometry.inliers

    @property
    def points(self) -> np.ndarray:
        """What corners show ``(n, 3)``, in base axes at the newest step."""
        return self._odometry.points

    @property
    def waiting(self) -> int:
        """Pictures that wait for odometry."""
        return len(self._waiting)

    def ready(self, at_end: bool = False) -> Iterator[RelativeStep]:
        """The steps of pictures whose odometry is known; at the end, of all that lie within it."""
        while self._waiting:
            stamp_ns, grey = self._waiting[0]
            waits = not self.has_wheels or self._wheels.newest_ns < stamp_ns
            if waits and not at_end and not self._by_floor:
                return
            self._waiting.popleft()
            given = self._given if self._by_floor else self._wheels.pose_at(stamp_ns * 1e-9)
            if given is None:
                self.unplaced += 1
            elif (step := self._step(stamp_ns, grey, given)) is not None:
                yield step

    @property
    def clocks(self) -> str:
        """The newest stamps of pictures and odometry, in words."""
        odometry = f"{self._wheels.newest_ns * 1e-9:.3f} s" if self.has_wheels else "none"
        picture = "none" if self._newest_ns is None else f"{self._newest_ns * 1e-9:.3f} s"
        return f"newest stamp of pictures {picture}, of odometry {odometry}"

    def _step(self, stamp_ns: int, grey: Grey, given: np.ndarray) -> RelativeStep | None:
        odometry, last_ns = self._odometry, self._last_ns
        motion, unknown = self._motion(last_ns, stamp_ns, given)
        relative, covariance = odometry.add(grey, motion, unknown)
        self._last_ns, self._given = stamp_ns, given
        if last_ns is None:
            self._origin_ns, self._origin_code = stamp_ns, self._key_code(grey)
            return None
        self.frames += 1
        self.by_wheels += odometry.inliers < self._config.least_inliers
        if self._by_floor:
            self.floorless += not odometry.floor_seen
            took_s, blind = (stamp_ns - last_ns) * 1e-9, not odometry.scaled
            self._velocity = np.zeros(3) if blind else relative / took_s
            self._blind_s = self._blind_s + took_s if blind else 0.0
        moved = between(self._key_pose, odometry.pose)
        is_key = math.hypot(moved[0], moved[1]) > self._config.key_m or abs(moved[2]) > self._config.key_rad
        origin, self._origin_code = self._origin_code, None
        return RelativeStep(
            stamp_ns, last_ns, relative, covariance, self._origin_ns, odometry.pose.copy(), _NOTHING,
            self._key_code(grey) if is_key else _NOTHING, from_place_code=origin,
            robot_odom_xyyaw=None if self._by_floor else given.copy(),
        )  # fmt: skip

    def _motion(self, last_ns: int | None, stamp_ns: int, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The motion ``(3,)`` to a picture by the wheels, whose pose is ``given`` there, and variances ``(3,)`` of what
        they leave open of it (m, m, rad): the way in a gap between readings, and all of it where their frame jumped, or
        there are none. Then the velocity goes on, for as long as a robot takes to stop: it may stand after that."""
        motion, config = between(self._given, given), self._config
        if last_ns is None:
            return motion, np.zeros(3)
        took_s = (stamp_ns - last_ns) * 1e-9
        speeds = np.array((math.hypot(motion[0], motion[1]), abs(motion[2]))) / max(took_s, config.least_s)
        speed, acceleration = np.array(config.unknown_speed), np.array(config.unknown_acceleration)
        jumped = bool((speeds > config.fastest).any())
        self.jumps += jumped
        if jumped or self._by_floor:
            open_s2 = (self._blind_s + took_s) ** 2 - self._blind_s**2  # a wrong velocity adds up
            goes_on = (took_s <= speed / acceleration)[[0, 0, 1]]
            return self._velocity * took_s * goes_on, (speed**2 * open_s2)[[0, 0, 1]]
        self._velocity = motion / took_s
        # Between two readings the way strays from the line between them by so much, and by no more than the robot goes;
        # from one reading to the other it does not (a Brownian bridge).
        lengths_s, inside_s = self._wheels.gaps(last_ns * 1e-9, stamp_ns * 1e-9, config.silent_s)
        strays = np.minimum(acceleration * lengths_s[:, None] ** 2 / 8.0, speed * lengths_s[:, None] / 2.0)
        share = inside_s / lengths_s
        variances: np.ndarray = (share * (1.0 - share)) @ strays**2
        return motion, variances[[0, 0, 1]]

    def _key_code(self, grey: Grey) -> np.ndarray:
        self._key_pose = self._odometry.pose.copy()
        pixels, std, descriptors = (found[: self._config.features] for found in self._describer.describe(grey))
        rays, std_rad = self.model.rays(pixels), std * self.model.pixel_rad
        return KeyPicture.of(self.model.centre, rays, std_rad, descriptors).packed()


def _grey(picture: np.ndarray) -> Grey:
    if picture.ndim == 2 or picture.shape[2] == 1:
        return np.ascontiguousarray(picture.reshape(picture.shape[:2]))
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
