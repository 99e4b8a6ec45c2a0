"""Simulator and both estimators on a Doom map that is no maze, as real processes over DDS."""

import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image

from ngo_sim.doom_engine import SHIPPED
from ngo_sim.doom_wad import find_wad, read_wad, write_lumps

from .processes import NodeProcess, Probe
from .readings import stamps_ns

pytestmark = pytest.mark.processes

FRAMES = 120
SCENARIO = {"wad": "my_way_home.wad", "map": "map01"}


def test_the_estimators_run_unchanged_on_a_scenario_that_vizdoom_ships(probe: Probe) -> None:
    """Every frame gets a corrected pose, and the corrected motion is about as long as the true one."""
    weights = {"world": "doom"}
    received = {**weights, "image_reliability": "reliable", "image_depth": 100}  # a busy machine must lose none
    with (
        NodeProcess("ngo_estimator", "local_node", received) as local,
        NodeProcess("ngo_estimator", "ngo_node", weights) as ngo,
    ):
        local.wait_for_log("ready: ")
        ngo.wait_for_log("ready: ")
        truth = probe.collect(Odometry, "ground_truth")
        odometry = probe.collect(Odometry, "odom")
        corrected = probe.collect(PoseWithCovarianceStamped, "ngo/pose")
        probe.meet("local_node", "ngo_node")
        images = probe.collect(Image, "image")  # last: the simulator waits for it, and for local_node
        run = {"seed": 1001, "frames": FRAMES, "rate": 0.0}
        waiting = {"wait_for_subscribers": 2, "wait_for_flow_control": True}
        with NodeProcess("ngo_sim", "maze3d", {**run, **waiting, **SCENARIO}) as simulator:
            # While it runs: it ends when both estimators have answered its last frame.
            probe.spin_until(lambda: len(images) == len(truth) == FRAMES, "all frames")
            probe.spin_until(lambda: len(corrected) == len(odometry) == FRAMES - 1, "every pose")
            probe.spin_until(lambda: not simulator.running, "the simulator's end")
            assert simulator.wait() == 0, simulator.log
    # A relative pose leads to each frame but the first.
    assert stamps_ns(corrected) == stamps_ns(odometry) == stamps_ns(images)[1:]
    true = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in truth])
    found = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in corrected])
    true_m, found_m = (float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) for path in (true, found))
    assert true_m > 5.0, "the explorer drove"
    assert np.isfinite(found).all() and math.isclose(found_m, true_m, rel_tol=0.5)


def test_an_engine_that_dies_ends_the_node_with_one_line() -> None:
    with NodeProcess("ngo_sim", "maze3d", {**SCENARIO, "rate": 100.0}) as node:
        node.wait_for_log("ready: ")
        (engine,) = node.children()
        os.kill(engine, signal.SIGKILL)
        assert node.wait() == 1, node.log
        assert "Traceback" not in node.log, node.log
        assert node.lines[-1].startswith("[FATAL]") and "the engine has ended" in node.lines[-1]


def test_a_damaged_map_ends_the_node_with_one_line(tmp_path: Path) -> None:
    text = dict(read_wad(find_wad(SCENARIO["wad"], SHIPPED)).lumps)["TEXTMAP"]
    write_lumps(tmp_path / "bad.wad", [("MAP01", b""), ("TEXTMAP", text[:-9]), ("ENDMAP", b"")])
    with NodeProcess("ngo_sim", "maze3d", {"wad": str(tmp_path / "bad.wad"), "map": "MAP01"}) as node:
        assert node.wait() == 2, node.log
        assert len(node.lines) == 1 and "map is 'MAP01' of bad.wad, which cannot be played: " in node.log
