import math

import numpy as np
import pytest

from ngo_sim.building2d import Building2d
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.maze2d import Maze2D
from ngo_sim.simulation import Simulation
from ngo_sim.velocity_command import VelocityCommand, VelocityLimits
from tests.unit.ngo_sim.test_building2d import gap_to_walls

LIMITS = VelocityLimits(speed_mps=1.0, turn_rate_rps=2.0, acceleration_mps2=0.5, turn_acceleration_rps2=4.0)


def test_speed_and_turn_rate_rise_by_the_acceleration_and_end_at_the_limits() -> None:
    command, twist = VelocityCommand(LIMITS, timeout_s=100.0), np.zeros(2)
    command.set(5.0, -9.0)
    found = []
    for _ in range(30):
        twist = command.next_twist(twist, 0.1)
        found.append(twist)
    speeds, rates = np.array(found).T
    np.testing.assert_allclose(speeds, np.minimum(0.05 * np.arange(1, 31), 1.0))
    np.testing.assert_allclose(rates, np.maximum(-0.4 * np.arange(1, 31), -2.0))


def test_a_silent_command_brakes_after_the_timeout() -> None:
    command, twist = VelocityCommand(LIMITS, timeout_s=0.3), np.array((1.0, 0.0))
    command.set(1.0, 0.0)
    speeds = []
    for _ in range(6):
        twist = command.next_twist(twist, 0.1)
        speeds.append(twist[0])
    np.testing.assert_allclose(speeds, [1.0, 1.0, 1.0, 0.95, 0.9, 0.85])


def building() -> Building2d:
    config = BuildingDriverConfig(driver="cmd_vel", speed_mps=1.0)
    found = Building2d(FloorPlanConfig(scale=0.3, layout="ring"), ScannerConfig(rays=36), driver=config)
    found.reset(4)
    return found


def test_a_commanded_robot_in_a_building_runs_into_a_wall_and_stops_before_it() -> None:
    world = building()
    radius = BuildingDriverConfig().radius_m
    before = world.step().true_pose_xyyaw
    for _ in range(400):
        world.command(1.0, 0.0)
        frame = world.step()
        if world.blocked:
            break
    assert world.blocked, "it met something"
    heading = before[2]
    moved = frame.true_pose_xyyaw[:2] - before[:2]
    assert moved @ (math.cos(heading), math.sin(heading)) > 0.0
    walls = np.concatenate((world.plan.segments_m, world.plan.doors.leaves(np.zeros(1))[0]))
    (gap,) = gap_to_walls(world.plan, world.step().true_pose_xyyaw[None, :2], walls)
    assert radius <= gap < radius + 0.05, "it stands before what it met, and touches nothing"
    world.command(-1.0, 0.0)
    world.step()
    assert not world.blocked, "it can back away"


def test_a_robot_with_a_driver_of_its_own_takes_no_commands() -> None:
    world = Building2d(FloorPlanConfig(scale=0.3, layout="ring"), ScannerConfig(rays=36))
    world.reset(4)
    with pytest.raises(ValueError, match="cmd_vel"):
        world.command(1.0, 0.0)


def test_a_commanded_robot_in_a_maze_drives_to_the_wall_and_stops() -> None:
    run = Simulation(Maze2D(), seed=3, driver="cmd_vel", velocity_timeout_s=0.3)
    assert run.velocity is not None
    assert run.ready(0.0, 0.5, hold=True), "time goes on without a command"
    still = run.frame.pose_xyyaw
    frame, _ = run.drive()
    np.testing.assert_array_equal(frame.pose_xyyaw, still)
    for _ in range(60):
        run.velocity.set(0.8, 0.0)
        frame, blocked = run.drive()
        if blocked:
            break
    assert blocked
    after, _ = run.drive()
    assert np.hypot(*(after.pose_xyyaw - frame.pose_xyyaw)[:2]) < 0.06, "it begins anew from standing"
    run.velocity.set(0.0, 1.0)
    turned, _ = run.drive()
    assert turned.pose_xyyaw[2] != after.pose_xyyaw[2]
