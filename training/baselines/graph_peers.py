"""Other ways to solve a pose graph with wrong loops: GTSAM's kernels and graduated non-convexity, and PCM.

All get the measurements and the covariances that our corrector gets. Each runs in a process of its own, which is
stopped where it computes for too long: that does not depend on how busy the machine is.
"""

import multiprocessing
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import gtsam
import numpy as np

from ngo_estimator.graph.corrector import GraphProblem, thresholds
from ngo_estimator.graph.cycle_agreement import ChainUncertainty
from ngo_estimator.graph.relative_poses import RelativePoses

_UNKNOWN_STD = 1e3  # Deviation (rad) that GTSAM gets for a heading of which nothing is known.

_CAUCHY, _DCS, _GEMAN_MCCLURE = 3.0, 1.0, 3.0
_INLIER_PROBABILITY = 0.99
_ANCHOR_STD, _TOLERANCE = 1e-6, 1e-6
_SEEDS = 20  # nodes where a search for a clique begins

Peer = Callable[[GraphProblem], np.ndarray]  # Poses ``(nodes, 3)`` of a problem.


def cauchy(problem: GraphProblem) -> np.ndarray:
    """Levenberg-Marquardt with a Cauchy kernel of three deviations on loops."""
    return _minimum(problem, gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY))


def cauchy_on_all(problem: GraphProblem) -> np.ndarray:
    """The same with that kernel on steps, too."""
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
    return _minimum(problem, kernel, kernel)


def dcs(problem: GraphProblem) -> np.ndarray:
    """The same with dynamic covariance scaling (Agarwal et al. 2013) on loops."""
    return _minimum(problem, gtsam.noiseModel.mEstimator.DCS.Create(_DCS))


def geman_mcclure(problem: GraphProblem) -> np.ndarray:
    """The same with a Geman-McClure kernel on loops."""
    return _minimum(problem, gtsam.noiseModel.mEstimator.GemanMcClure.Create(_GEMAN_MCCLURE))


def least_squares(problem: GraphProblem) -> np.ndarray:
    """Every loop is believed: for graphs whose loops are right."""
    return _minimum(problem)


def _minimum(problem: GraphProblem, on_loops: Any | None = None, on_steps: Any | None = None) -> np.ndarray:
    """Poses by Levenberg-Marquardt with GTSAM's kernels, or with none: least squares."""
    graph = _anchored(problem)
    _add(graph, problem.steps, on_steps)
    _add(graph, _stated(problem.loops), on_loops)
    return xyyaw(gtsam.LevenbergMarquardtOptimizer(graph, values(problem.poses), _lm()).optimize())


def gnc(problem: GraphProblem) -> np.ndarray:
    """Graduated non-convexity over truncated least squares (Yang et al. 2020), with every step for an inlier."""
    if not len(problem.loops):
        return problem.poses.copy()
    graph = _anchored(problem)
    _add(graph, problem.steps)
    trusted = graph.size()
    _add(graph, _stated(problem.loops))
    parameters = gtsam.GncLMParams(_lm())
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(trusted)))
    optimizer = gtsam.GncLMOptimizer(graph, values(problem.poses), parameters)
    optimizer.setInlierCostThresholdsAtProbability(_INLIER_PROBABILITY)
    return xyyaw(optimizer.optimize())


def _lm() -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(_TOLERANCE)
    return parameters


def _anchored(problem: GraphProblem) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, _ANCHOR_STD)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*problem.poses[0]), noise))
    return graph


def _add(graph: gtsam.NonlinearFactorGraph, measured: RelativePoses, kernel: Any | None = None) -> None:
    # GTSAM's residual of a between factor lies in the frame of the measured pose, ours along the axes of the first one.
    cosine, sine = np.cos(measured.relative[:, 2]), np.sin(measured.relative[:, 2])
    turn = np.zeros((len(measured.nodes), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cosine, -sine, sine, cosine, 1.0
    roots = measured.root @ turn
    for (first, second), relative, root in zip(measured.nodes.tolist(), measured.relative, roots, strict=True):
        noise: Any = gtsam.noiseModel.Gaussian.Information(root.T @ root)
        if kernel is not None:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        graph.add(gtsam.BetweenFactorPose2(first, second, gtsam.Pose2(*relative), noise))


def values(poses: np.ndarray) -> gtsam.Values:
    """Poses ``(nodes, 3)`` as GTSAM takes them."""
    result = gtsam.Values()
    for node, pose in enumerate(poses):
        result.insert(node, gtsam.Pose2(*pose))
    return result


def xyyaw(values: gtsam.Values) -> np.ndarray:
    """Poses ``(nodes, 3)`` in the order of the nodes."""
    return np.asarray(gtsam.utilities.extractPose2(values))


def pcm(problem: GraphProblem) -> np.ndarray:
    """Least squares with the largest set of loops that agree pair by pair (Mangelson et al. 2018), found greedily.

    Raises:
        ValueError: a loop has no whole relative pose.
    """
    loops = problem.loops
    chain, limit, agree = ChainUncertainty(problem.steps), thresholds(loops)[0], np.zeros((len(loops),) * 2, bool)
    for first in range(len(loops) - 1):
        second = np.arange(first + 1, len(loops))
        off, _ = chain.off_pairs(loops, np.stack((np.full(len(second), first), second), axis=1))
        agree[first, second] = off <= limit
    agree |= agree.T
    kept = _clique(agree)
    return least_squares(replace(problem, loops=loops[kept], trust=problem.trust[kept]))


def _clique(agree: np.ndarray) -> np.ndarray:
    """Members ``(n,)`` of a large clique: from each of the best connected, always the best connected that is left."""
    degree, best = agree.sum(1), np.zeros(0, np.int64)
    for seed in np.argsort(-degree, kind="stable")[:_SEEDS]:
        members, left = [seed], agree[seed].copy()
        while left.any():
            following = int(np.argmax(np.where(left, degree, -1)))
            members.append(following)
            left &= agree[following]
        if len(members) > len(best):
            best = np.sort(np.array(members))
    return best


def _stated(loops: RelativePoses) -> RelativePoses:
    """The same with a little information about every direction, as GTSAM needs it."""
    root = loops.root.copy()
    unknown = ~(root != 0.0).any(2)
    np.einsum("kii->ki", root)[unknown] = 1.0 / _UNKNOWN_STD
    return replace(loops, root=root)


def within(solve: Peer, problem: GraphProblem, limit_s: int) -> tuple[np.ndarray, float] | None:
    """What a peer finds, and its computing time (s); None where it fails or computes for longer than ``limit_s``."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_answer, args=(theirs, solve, problem, limit_s))
    process.start()
    theirs.close()
    try:
        poses, seconds = ours.recv()
    except EOFError:  # it was stopped, or it died of an error
        return None
    finally:
        process.join()
    return poses, seconds


def _answer(pipe: Connection, solve: Peer, problem: GraphProblem, limit_s: int) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
    began = time.process_time()
    poses = solve(problem)
    if np.isfinite(poses).all():
        pipe.send((poses, time.process_time() - began))
