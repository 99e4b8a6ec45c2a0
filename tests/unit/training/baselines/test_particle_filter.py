"""The particle filter finds a robot in a room where no two places look alike, and does not where all do."""

import math

import numpy as np
import torch

from tests.unit.ngo_estimator.rooms import CONFIG, ranges_at, round_trip
from training.baselines.particle_filter import ParticleFilter, ParticleFilterConfig, RangeMap

ANGLES = CONFIG.angles_rad.double().numpy()
SMALL = ParticleFilterConfig(most=4000, hit_m=0.1)


def test_a_robot_in_the_room_is_found() -> None:
    poses = round_trip(40)
    ranges = ranges_at(poses).numpy()
    range_map = RangeMap.of_scans(poses.numpy(), ranges, ANGLES)
    # The room has 22.5 m2, less its pillar and 15 cm along the walls.
    assert 15.0 < len(range_map.free) * 0.05**2 < 22.5
    found = ParticleFilter(SMALL, range_map, ANGLES, 8.0, seed=1)
    turned = poses[1:, 2] - poses[:-1, 2]
    cos, sin = torch.cos(poses[:-1, 2]), torch.sin(poses[:-1, 2])
    x, y = (poses[1:, :2] - poses[:-1, :2]).T
    steps = torch.stack((cos * x + sin * y, cos * y - sin * x, turned), dim=-1).numpy()
    claims = [found.update(step, seen) for step, seen in zip(steps, ranges[1:], strict=True)]
    known = [pose for pose in claims if pose is not None]
    assert claims[0] is None and len(known) > 10
    off = known[-1] - poses[-1].numpy()
    assert math.hypot(off[0], off[1]) < 0.15 and abs(math.remainder(off[2], 2.0 * math.pi)) < 0.1


def test_without_ranges_nothing_is_claimed() -> None:
    poses = round_trip(20)
    range_map = RangeMap.of_scans(poses.numpy(), ranges_at(poses).numpy(), ANGLES)
    found = ParticleFilter(SMALL, range_map, ANGLES, 8.0, seed=1)
    assert all(found.update(np.array((0.3, 0.0, 0.0)), np.zeros(len(ANGLES))) is None for _ in range(10))
