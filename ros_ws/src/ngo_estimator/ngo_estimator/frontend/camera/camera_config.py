"""Settings of the odometry of a calibrated camera."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraConfig:
    """The odometry of a calibrated camera."""

    # Corners that are followed at once.
    corners: int = 220
    # Distance between two of them, as a share of the picture's width.
    apart: float = 0.02
    # Standard deviation of where a corner is found: pixels, and a share of its parallax, for patches that grow or turn
    # are followed worse.
    pixel_std: float = 0.1
    parallax_std: float = 0.03
    # The same in pixels for its range, whose measurements share the errors of one patch.
    range_pixel_std: float = 0.4
    # Standard deviations of the given motion: a share of the way and of the turn, and per frame besides (m, rad).
    given_way_share: float = 0.03
    given_turn_share: float = 0.15
    given_m: float = 0.004
    given_rad: float = 0.01
    # Turn that the given motion may miss, rad for each m.
    given_rad_per_m: float = 0.05
    # Without wheels: the least share of corners below the horizon that move as the floor does, and the camera's least
    # height over it (m).
    floor_share: float = 0.4
    least_height_m: float = 0.05
    # Silence of the odometry (s) beyond which its straight line through the gap counts as a guess.
    silent_s: float = 0.25
    # Deviations of speed (m/s, rad/s) and acceleration (m/s^2, rad/s^2) where nobody knows them.
    unknown_speed: tuple[float, float] = (1.0, 1.0)
    unknown_acceleration: tuple[float, float] = (1.0, 2.0)
    # Speeds (m/s, rad/s) beyond which the given motion is a jump of its frame, and the least time they are taken over
    # (s): robots and cars in towns are slower, and a driver that starts again is farther away.
    fastest: tuple[float, float] = (15.0, 10.0)
    least_s: float = 0.03
    # Deviation of the share by which all ranges are wrong together.
    scale_std: float = 0.1
    # Standard deviation of how much higher or lower the camera comes to be: a share of the way, and besides (m).
    rise_share: float = 0.1
    rise_m: float = 0.002
    # Way (m) and turn (rad) after which corners are looked for and ranges are measured.
    step_m: float = 0.3
    step_rad: float = 0.12
    # The same where fewer corners than this share are left.
    left_share: float = 0.6
    # Fewest corners that agree: with fewer the given motion counts alone.
    least_inliers: int = 12
    # Way (m) and turn (rad) from one key picture to the next, and features of one.
    key_m: float = 0.7
    key_rad: float = 0.35
    features: int = 400
    # Factor on deviations of the fit, whose errors last from frame to frame.
    std_factor: float = 5.0
