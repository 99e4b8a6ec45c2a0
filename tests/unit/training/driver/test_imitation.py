"""What a pupil's decisions turned out to be worth."""

import numpy as np

from training.driver.imitation import discounted


def test_returns_end_with_their_episode_and_are_left_out_where_it_is_cut_off() -> None:
    rewards = np.stack((2.0 ** np.arange(8), np.arange(8) % 2.0), axis=1)
    overs = np.zeros((8, 2), bool)
    overs[5, 0] = True
    returns = discounted(rewards, overs, discount=0.5)  # six rewards are enough
    assert returns.shape == (8, 2)
    np.testing.assert_allclose(returns[0, 0], 6.0)  # 1 + 2/2 + 4/4 + ... + 32/32
    assert np.isnan(returns[1:, 0]).all(), "the episode ends five decisions later, or is cut off"
    np.testing.assert_allclose(returns[:3, 1], [0.5 + 0.125 + 0.03125 + 0.0078125, 1.328125, 0.65625], atol=0.01)
    assert np.isnan(returns[3:, 1]).all()
