"""Odometry of a differential drive that nobody calibrated: bias, slip, freezes, jumps and a lag against the scans."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from ngo_sim.convex_shapes import Floats

# Seconds and metres that an event lasts, drawn evenly.
_SLIP_S = (0.3, 1.5)
_FREEZE_S = (0.7, 1.3)
_SLIP_SHARE = (-0.6, 0.6)


@dataclass(frozen=True)
class WheelsConfig:
    """Errors of the wheel odometry."""

    track_m: float = 0.4  # distance between the wheels, m [0.05 to 2]
    left_bias: float = 0.0  # by which share the left wheel counts too much [-0.2 to 0.2]
    right_bias: float = 0.0  # by which share the right wheel counts too much [-0.2 to 0.2]
    wheel_noise: float = 0.01  # standard deviation of a wheel's way after 1 m, growing with its root, m [0 to 1]
    slips_per_km: float = 0.0  # bursts of 0.3 to 1.5 s in which one wheel miscounts by up to 60 % [0 to 10000]
    freezes_per_hour: float = 0.0  # times that the odometry stands still for about a second, then jumps [0 to 3600]
    jumps_per_hour: float = 0.0  # times that the odometry leaps by jump_m without any motion [0 to 3600]
    jump_m: float = 0.3  # standard deviation of such a leap along x and y, m; 0.3 rad a metre of it in yaw [0 to 2]
    lag_s: float = 0.0  # by which scans are older than their stamps, against the odometry, s [-0.2 to 0.2]

    def __post_init__(self) -> None:
        for name, low, high in (
            ("track_m", 0.05, 2.0),
            ("left_bias", -0.2, 0.2),
            ("right_bias", -0.2, 0.2),
            ("wheel_noise", 0.0, 1.0),
            ("slips_per_km", 0.0, 10_000.0),
            ("freezes_per_hour", 0.0, 3600.0),
            ("jumps_per_hour", 0.0, 3600.0),
            ("jump_m", 0.0, 2.0),
            ("lag_s", -0.2, 0.2),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise ValueError(f"{name} is {value!r}; it must be a number from {low:g} to {high:g}")


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
