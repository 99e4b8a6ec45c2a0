"""The learned driver: a small network that looks at the pictures and was trained to travel far."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ngo_sim.drivers import Action
from ngo_sim.policy_network import PolicyNetwork, PolicyView, load_policy


class LearnedDriver:
    """Draws each decision from the odds that its network gives, and holds it for the frames of the network's config.

    network: by default the one that is shipped. The frames must be those of the 3D world, as it is by default or in
    whole multiples of its size.
    """

    def __init__(self, rng: np.random.Generator, network: PolicyNetwork | None = None) -> None:
        self._rng = rng
        self._network = load_policy() if network is None else network
        self._view = PolicyView(self._network.config)
        self._action = Action.FORWARD
        self._held_frames = 0

    def action(self, pose_xyyaw: np.ndarray, observation: npt.NDArray[Any] | None = None) -> Action:
        """The action to take on an observation, uint8 (height, width, 3), at pose_xyyaw (3,); call it once a frame.

        Of the poses only the motion between them enters, as wheels would tell it.

        Raises ValueError for another observation, or none.
        """
        if observation is None:
            raise ValueError("observation is None; the learned driver has to see")
        if self._held_frames == 0:
            self._view.see(observation, pose_xyyaw)
            logits = self._network.logits(self._view).astype(np.float64)
            odds = np.exp(logits - logits.max())
            drawn = self._rng.random() * odds.sum()
            self._action = Action(int((np.cumsum(odds)[:-1] <= drawn).sum()))
            self._view.did(self._action)
        self._held_frames = (self._held_frames + 1) % self._network.config.hold_frames
        return self._action
