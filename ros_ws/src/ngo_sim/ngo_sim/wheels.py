"""Odometry of a differential drive that nobody calibrated: bias, slip, freezes, jumps and a lag against the scans."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from ngo_common.settings import Settings, setting
from ngo_sim.convex_shapes import Floats

# Seconds and metres that an event lasts, drawn evenly.
_SLIP_S = (0.3, 1.5)
_FREEZE_S = (0.7, 1.3)
_SLIP_SHARE = (-0.6, 0.6)


@dataclass(frozen=True)
class WheelsConfig(Settings):
    """Errors of the wheel odometry."""

    track_m: float = setting(0.4, "Distance between the wheels, m.", minimum=0.05, maximum=2.0)
    left_bias: float = setting(0.0, "Share by which the left wheel counts too much.", minimum=-0.2, maximum=0.2)
    right_bias: float = setting(0.0, "Share by which the right wheel counts too much.", minimum=-0.2, maximum=0.2)
    wheel_noise: float = setting(
        0.01,
        "Standard deviation of a wheel's distance after 1 m, m. It grows with the root of the distance.",
        minimum=0.0,
        maximum=1.0,
    )
    slips_per_km: float = setting(
        0.0,
        "Slips of one wheel per km. A slip lasts 0.3 to 1.5 s and miscounts by up to 60 %.",
        minimum=0.0,
        maximum=10000.0,
    )
    freezes_per_hour: float = setting(
        0.0,
        "Freezes of the odometry per hour. A freeze lasts about 1 s; then the pose catches up.",
        minimum=0.0,
        maximum=3600.0,
    )
    jumps_per_hour: float = setting(
        0.0, "Jumps of the odometry per hour, without any motion of the robot.", minimum=0.0, maximum=3600.0
    )
    jump_m: float = setting(
        0.3,
        "Standard deviation of a jump in x and in y, m. In yaw it is 0.3 rad per metre of that.",
        minimum=0.0,
        maximum=2.0,
    )
    lag_s: float = setting(
        0.0,
        "Time by which the stamps of the odometry are earlier than those of the scans, s.",
        minimum=-0.2,
        maximum=0.2,
    )


def draw_wheels(rng: np.random.Generator) -> WheelsConfig:
    """Wheels from good to bad; one robot in three freezes, one in five jumps, and most lag."""
    common = rng.normal(0.0, 0.02)
    track, apart = float(rng.uniform(0.25, 0.6)), float(rng.choice((0.001, 0.003, 0.008)))
    return WheelsConfig(
        track_m=track,
        left_bias=float(np.clip(common + rng.normal(0.0, apart), -0.2, 0.2)),
        right_bias=float(np.clip(common + rng.normal(0.0, apart), -0.2, 0.2)),
        wheel_noise=float(rng.uniform(0.002, 0.02)),
        slips_per_km=float(rng.choice((0.0, rng.uniform(2.0, 60.0)))),
        freezes_per_hour=float(rng.choice((0.0, 0.0, rng.uniform(10.0, 80.0)))),
        jumps_per_hour=float(rng.choice((0.0, 0.0, 0.0, 0.0, rng.uniform(2.0, 20.0)))),
        jump_m=float(rng.uniform(0.05, 0.5)),
        lag_s=float(rng.choice((0.0, rng.uniform(0.0, 0.2)))),
    )


class WheelOdometry:
    """Integrates true motion as the wheels count it. It starts at the origin of its own frame, `odom`."""

    def __init__(self, config: WheelsConfig, period_s: float, rng: np.random.Generator) -> None:
        self.config, self._period_s, self._rng = config, period_s, rng
        # x, y, yaw as counted; x, y, yaw as published; seconds left of a slip, its left and right share; of a freeze.
        self._state = np.zeros(10)

    @property
    def pose_xyyaw(self) -> Floats:
        """(3,) as published now."""
        return np.array(self._state[3:6])

    def advance(self, motions: Floats) -> Floats:
        """(k, 3) published poses after each of k motions (k, 2): way along the arc in m, turn in rad.

        Each motion takes one period. All at once give the same as one by one.
        """
        config = self.config
        return np.asarray(
            _advance(
                self._state,
                np.ascontiguousarray(motions, dtype=np.float64),
                self._period_s,
                config.track_m,
                config.left_bias,
                config.right_bias,
                config.wheel_noise,
                config.slips_per_km / 1000.0,
                config.freezes_per_hour / 3600.0,
                config.jumps_per_hour / 3600.0,
                config.jump_m,
                self._rng,
            )
        )


@njit(cache=True)
def _advance(
    state: Floats,
    motions: Floats,
    period: float,
    track: float,
    left_bias: float,
    right_bias: float,
    noise: float,
    slips_per_m: float,
    freezes_per_s: float,
    jumps_per_s: float,
    jump: float,
    rng: np.random.Generator,
) -> Floats:
    poses = np.empty((len(motions), 3))
    for index in range(len(motions)):
        way, turn = motions[index]
        left, right = way - turn * track / 2, way + turn * track / 2
        if state[6] > 0.0:
            state[6] -= period
        elif slips_per_m > 0.0 and rng.random() < slips_per_m * (abs(left) + abs(right)) / 2:
            state[6] = rng.uniform(_SLIP_S[0], _SLIP_S[1])
            share = rng.uniform(_SLIP_SHARE[0], _SLIP_SHARE[1])
            side = rng.random()
            # One wheel in most bursts, both on a smooth floor.
            state[7] = share if side < 0.6 else 0.0
            state[8] = share if side >= 0.4 else 0.0
        slip_left, slip_right = (state[7], state[8]) if state[6] > 0.0 else (0.0, 0.0)
        if noise > 0.0:
            noisy_left = noise * math.sqrt(abs(left)) * rng.standard_normal()
            noisy_right = noise * math.sqrt(abs(right)) * rng.standard_normal()
        else:
            noisy_left = noisy_right = 0.0
        left = left * (1.0 + left_bias) * (1.0 + slip_left) + noisy_left
        right = right * (1.0 + right_bias) * (1.0 + slip_right) + noisy_right
        way, turn = (left + right) / 2, (right - left) / track
        if abs(turn) > 1e-9:
            way *= math.sin(turn / 2) / (turn / 2)
        state[0] += way * math.cos(state[2] + turn / 2)
        state[1] += way * math.sin(state[2] + turn / 2)
        state[2] += turn
        if jumps_per_s > 0.0 and rng.random() < jumps_per_s * period:
            state[0] += jump * rng.standard_normal()
            state[1] += jump * rng.standard_normal()
            state[2] += 0.3 * jump * rng.standard_normal()
        if state[9] > 0.0:
            state[9] -= period
        elif freezes_per_s > 0.0 and rng.random() < freezes_per_s * period:
            state[9] = rng.uniform(_FREEZE_S[0], _FREEZE_S[1])
        if state[9] <= 0.0:
            state[3:6] = state[0:3]
            state[5] = (state[5] + math.pi) % (2 * math.pi) - math.pi
        poses[index] = state[3:6]
    return poses
