"""The online estimate of an evaluation is what was known at the time, and only that."""

import numpy as np

from ngo_estimator.ngo.whole_trajectory import optimize_offline
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head, trajectory_inputs
from training.scoring.online_estimate import online_poses

NAMES = ("relative", "log_std", "motion", "codes")


def test_an_online_pose_is_the_last_one_of_what_came_before_it() -> None:
    optimizer, pair_head = small_optimizer(trained=True), small_pair_head()
    inputs = [values[0] for values in trajectory_inputs(1, 60, seed=3)]
    core = OnlineTrajectory(optimizer, pair_head, 64)
    features = {name: values.numpy() for name, values in zip(NAMES, inputs, strict=True)}
    features["origin_code"] = np.zeros((1, 12))
    online = online_poses(core, features)
    assert online.shape == (61, 3) and online[0].tolist() == [0.0, 0.0, 0.0]
    for steps in (16, 32, 45, 60):
        offline = optimize_offline(optimizer, pair_head, *(values[:steps] for values in inputs)).poses[0]
        np.testing.assert_allclose(online[steps, :2], offline[-1, :2], atol=2e-4)
    whole = optimize_offline(optimizer, pair_head, *inputs).poses[0].numpy()
    assert np.abs(online[1:, :2] - whole[:, :2]).max() > 0.05
    # What comes later changes nothing.
    shorter = online_poses(core, {name: values[:30] for name, values in features.items()})
    np.testing.assert_allclose(shorter, online[:31], atol=1e-9)
