"""The node of the building as a real process over DDS."""

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from ngo_sim.building2d import Building2d
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelsConfig

from .processes import LATCHED, NodeProcess, Probe
from .readings import stamps_ns, xyyaw

pytestmark = pytest.mark.processes

FRAMES = 30
PLAN = {"scale": 0.5, "layout": "ring"}
SCANNER = {"rays": 90, "laser_x_m": 0.1, "laser_yaw_deg": 90.0, "upside_down": True, "sweep": 0.5}
WHEELS = {"lag_s": 0.15, "left_bias": 0.02}


def test_it_publishes_what_the_core_gives(probe: Probe) -> None:
    mounted = probe.collect(TFMessage, "/tf_static", LATCHED)
    wheels, truth = probe.collect(Odometry, "wheels"), probe.collect(Odometry, "ground_truth")
    clock, tf = probe.collect(Clock, "/clock"), probe.collect(TFMessage, "/tf")
    scans = probe.collect(LaserScan, "scan")
    parameters = {**PLAN, **SCANNER, **WHEELS, "seed": 5, "rate": 0, "frames": FRAMES, "wait_for_subscribers": 1}
    parameters |= {"wheel_odometry_topic": "wheels", "publish_clock": True, "publish_tf": True}
    with NodeProcess("ngo_sim", "building2d", parameters) as node:
        probe.spin_until(lambda: not node.running, "the node's end")
        assert node.wait() == 0, node.log
        (ready,) = (line for line in node.lines if "ready: " in line)
        for messages in (scans, wheels, truth, clock, tf):
            probe.spin_until(lambda messages=messages: len(messages) == FRAMES, "all messages")
        probe.spin_until(lambda: mounted, "the mounting")
    assert "ready: /building2d, seed 5, as fast as the scans are taken, publishes /clock, /ground_truth, /scan" in ready
    assert ready.endswith("/wheels; waits for 1 subscribers of the scan")
    world = Building2d(FloorPlanConfig(**PLAN), ScannerConfig(**SCANNER), WheelsConfig(**WHEELS))  # type: ignore[arg-type]
    world.reset(5)
    frames = [world.step() for _ in range(FRAMES)]
    expected = [10**9 + round(index * 1e8) for index in range(FRAMES)]
    assert stamps_ns(scans) == stamps_ns(truth) == expected
    assert stamps_ns(wheels) == [stamp - 150_000_000 for stamp in expected]
    np.testing.assert_array_equal([scan.ranges for scan in scans], [frame.ranges_m for frame in frames])
    np.testing.assert_allclose([xyyaw(m) for m in truth], [frame.true_pose_xyyaw for frame in frames], atol=1e-9)
    np.testing.assert_allclose([xyyaw(m) for m in wheels], [frame.wheel_pose_xyyaw for frame in frames], atol=1e-9)
    first = scans[0]
    assert first.time_increment == pytest.approx(0.05 / 90)
    assert first.angle_min + 89 * first.angle_increment == pytest.approx(first.angle_max, abs=1e-5)
    assert (first.header.frame_id, wheels[0].header.frame_id, truth[0].header.frame_id) == ("laser", "odom", "building")
    (mounting,) = mounted[0].transforms
    q = mounting.transform.rotation
    assert (mounting.header.frame_id, mounting.child_frame_id) == ("base_link", "laser")
    forward = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y))
    assert forward == pytest.approx((0.0, 1.0, 0.0), abs=1e-9), "turned to the left"
    assert 1 - 2 * (q.x**2 + q.y**2) == pytest.approx(-1.0), "its z points down"
    links = {(t.header.frame_id, t.child_frame_id) for message in tf for t in message.transforms}
    assert links == {("odom", "base_link")}, "the truth is not on TF"
