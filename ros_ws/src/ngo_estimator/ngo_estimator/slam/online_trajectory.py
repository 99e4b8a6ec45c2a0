"""The online trajectory: relative poses in, the whole corrected trajectory out (no ROS here)."""

import dataclasses
import hashlib
import json
from functools import cached_property
from pathlib import Path
from typing import Any

from safetensors.torch import save

from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.place_back_end import PlaceBackEnd

_NETWORK_EVERY, _ANNEAL_EVERY = 32, 8
"""Meta-poses from one run of attention and convolutions to the next, and from one judgement of all loops to the next,
where steps are answered first."""


class OnlineTrajectory(CorrectedTrajectory):
    """Keeps the trajectory and re-optimises it whenever a meta-pose is complete.

    Between two meta-poses the newest frames follow the last corrected one by odometry. The last ``window_frames`` are
    optimised together. Within one window the result equals ``optimize_offline``. Overlaps are the exception: they are
    searched with the poses at that time.

    At most ``key_frames`` of the poses before the window are optimised with it, and a few more for a while. All others
    move with these. Loops are closed with key frames. So the cost of a step does not depend on the trajectory's length.

    With ``iterations_per_step`` 0 all of an update is done before the step that completes a meta-pose is answered. Else
    it is done after that (``correct``). Attention and convolutions are run for each 32nd meta-pose then, as what they
    give hardly changes from one to the next. All loops are judged for each eighth, and new ones alone between.
    """

    _back_end: PlaceBackEnd

    def __init__(
        self,
        optimizer: NeuralGraphOptimizer,
        pair_head: PairHead | None,
        window_frames: int = 2000,
        key_frames: int = 128,
        iterations_per_step: int = 0,
    ) -> None:
        block = optimizer.config.aggregation.block
        if window_frames < 2 * block:
            raise ValueError(f"window_frames is {window_frames}; expected at least {2 * block}, two meta-poses")
        if key_frames < 2:
            raise ValueError(f"key_frames is {key_frames}; expected at least 2")
        if optimizer.config.loops and pair_head is None:
            raise ValueError("an optimizer with loops needs a pair head")
        if optimizer.config.registrations and (pair_head is None or pair_head.config.registration is None):
            raise ValueError("an optimizer that registers ranges needs a pair head whose codes hold them")
        registers = optimizer.config.registrations and pair_head is not None and pair_head.config.registers_odometry
        if registers and optimizer.config.smoother is not None:
            raise ValueError(
                "a smoother learned from steps that are not registered; expected a registration of loops alone"
            )
        self._optimizer, self._pair_head = optimizer.eval(), pair_head
        self._block = block
        self._window = window_frames // block * block
        if iterations_per_step < 0:
            raise ValueError(f"iterations_per_step is {iterations_per_step}; expected 0 (before the answer) or more")
        self._key_frames = key_frames
        self._every = (_NETWORK_EVERY, _ANNEAL_EVERY) if iterations_per_step else (1, 1)
        super().__init__(answers_first=iterations_per_step > 0)

    @classmethod
    def load(
        cls,
        weights: Path,
        window_frames: int = 2000,
        world: str | None = None,
        key_frames: int = 128,
        iterations_per_step: int = 0,
    ) -> "OnlineTrajectory":
        """Load the networks in the folder ``weights``; raises ``CheckpointError``, of one clear line."""
        optimizer, description = load_optimizer(weights, world)
        if not optimizer.config.loops:
            return cls(optimizer, None, window_frames, key_frames, iterations_per_step)
        place, place_description = load_place(weights, description["world"])
        expected = description.get("place_encoder_sha256", place_description["sha256"])
        if place_description["sha256"] != expected:
            raise CheckpointError(
                f"{weights}: the optimizer was trained with another place encoder than the one beside it"
            )
        return cls(optimizer, place.pair_head, window_frames, key_frames, iterations_per_step)

    @property
    def block(self) -> int:
        """Steps in a meta-pose: the optimizer runs once in so many steps."""
        return self._block

    @property
    def feature_sizes(self) -> tuple[int, int]:
        """Lengths of a step's motion feature and place code, 0 where codes are not used."""
        codes = 0 if self._pair_head is None else self._pair_head.config.code_length
        return self._optimizer.config.aggregation.motion_feature_size, codes

    @property
    def window_frames(self) -> int:
        """Steps that are optimised together."""
        return self._window

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Settings, and a hash of the networks' configurations and weights."""
        digest = hashlib.sha256()
        for network in (self._optimizer, self._pair_head):
            if network is not None:
                digest.update(json.dumps(dataclasses.asdict(network.config), sort_keys=True).encode())
                digest.update(save({name: tensor.contiguous() for name, tensor in network.state_dict().items()}))
        return {
            "weights_sha256": digest.hexdigest(),
            "window_frames": self._window,
            "key_frames": self._key_frames,
            "answers_first": self._answers_first,
        }

    def _new_back_end(self) -> PlaceBackEnd:
        blocks = self._window // self._block
        return PlaceBackEnd(self._optimizer, self._pair_head, blocks, self._key_frames, *self._every, lambda: self._log)
