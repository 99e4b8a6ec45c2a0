"""Random observations and small configurations that the tests of this folder share."""

import torch
from torch import Tensor

from ngo_estimator.checkpoint import WORLD_IMAGES
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.loops.loop_closure import Loops, LoopSearch
from ngo_estimator.networks.local_pose_network import LocalPoseConfig
from ngo_estimator.networks.odometry_smoothing import SmootherConfig
from ngo_estimator.networks.place_encoder import PairHead, PlaceConfig
from ngo_estimator.ngo.meta_poses import OptimizedTrajectory
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig

WORLDS = ["maze2d", "maze3d"]

SCAN = ImageFormat(1, 289, 1, "float32", field_of_view_deg=360.0, depth_gain_m=1.5, depth_softening_m=0.75)
"""Scans of a robot of one's own."""


def observations(world: str, count: int, seed: int = 0) -> Tensor:
    image, generator = WORLD_IMAGES[world], torch.Generator().manual_seed(seed)
    values = torch.rand(count, *image.shape, generator=generator)
    return (values * 255).to(torch.uint8) if image.dtype == "uint8" else values


def local_config(world: str, **changes: object) -> LocalPoseConfig:
    return LocalPoseConfig(**{"image": WORLD_IMAGES[world], "width": 0.1, "actions": 3, "period_s": 0.1, **changes})  # type: ignore[arg-type]


def place_config(world: str, **changes: object) -> PlaceConfig:
    return PlaceConfig(**{"image": WORLD_IMAGES[world], "width": 0.1, "offset_scale_m": 0.5, **changes})  # type: ignore[arg-type]


def small_optimizer(
    form: str = "loops", trained: bool = False, seed: int = 0, **changes: object
) -> NeuralGraphOptimizer:
    """An optimizer for 6 motion features, fresh or with random weights that close loops and move every pose.

    ``form`` is ``loops``, ``smoothed`` (with a smoother), ``gauss_newton`` or ``paper``.
    """
    torch.manual_seed(0)
    aggregation = PoseAggregationConfig(motion_feature_size=6, width=16, relative_std=(0.1, 0.02, 0.05))
    make = NeuralGraphOptimizerConfig.paper_form if form == "paper" else NeuralGraphOptimizerConfig
    settings = {"aggregation": aggregation, "iterations": 3, **changes}
    if form != "paper":
        parts: dict[str, object] = {"network": form != "gauss_newton"}
        if form == "smoothed":
            parts["smoother"] = SmootherConfig(6, aggregation.relative_std, width=8)
        settings = {**parts, "search": LoopSearch(2, 8, 2, 0, 3), **settings}
    optimizer = NeuralGraphOptimizer(make(**settings)).eval()  # type: ignore[arg-type]
    if trained:
        with torch.no_grad():
            for name, parameter in optimizer.named_parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
                if name == "place_gain":
                    parameter.fill_(0.7)
    return optimizer.requires_grad_(False)


def small_pair_head() -> PairHead:
    """A pair head for place codes of 12 numbers."""
    torch.manual_seed(0)
    config = place_config("maze2d", code_size=12, embedding_size=8, pair_hidden_size=16)
    return PairHead(config).eval().requires_grad_(False)


def trajectory_inputs(batch: int, steps: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Relative poses, log deviations, motion features and place codes for ``small_optimizer``."""
    generator = torch.Generator().manual_seed(seed)
    std = torch.tensor([0.1, 0.02, 0.05])
    relative = torch.randn(batch, steps, 3, generator=generator) * std + torch.tensor([0.12, 0.0, 0.02])
    # Loops of an untrained pair head do not contradict it.
    log_std = 0.3 * torch.randn(batch, steps, 3, generator=generator) + std.log()
    motion = torch.rand(batch, steps, 6, generator=generator)
    return relative, log_std, motion, torch.randn(batch, steps, 12, generator=generator)


def optimized(optimizer: NeuralGraphOptimizer, inputs: tuple[Tensor, ...]) -> OptimizedTrajectory:
    """What an optimizer makes of ``trajectory_inputs``, with loops that ``small_pair_head`` sees if it takes any."""
    relative, log_std, motion, codes = inputs
    loops = optimizer.find_loops(relative, codes, small_pair_head()) if optimizer.config.loops else None
    result: OptimizedTrajectory = optimizer(relative, log_std, motion, loops)
    return result


def make_loops(start: list[int], end: list[int], measured: Tensor | None = None) -> Loops:
    """One trajectory's loops, in float64."""
    count = len(start)
    indices = torch.tensor([start]), torch.tensor([end]), torch.tensor([start])
    measured = torch.zeros(1, count, 3, dtype=torch.float64) if measured is None else measured
    number = torch.zeros(1, count, dtype=torch.float64)
    scale, embeddings = number.unsqueeze(-1).expand(-1, -1, 2), torch.zeros(1, 1, 1, dtype=torch.float64)
    return Loops(*indices, measured, scale, scale, number, number, number == 0.0, embeddings)


def with_origin(poses: Tensor) -> Tensor:
    """Global poses with the origin in front."""
    return torch.cat((torch.zeros_like(poses[:, :1]), poses), dim=1)


def meta_steps(blocks: int, seed: int = 0) -> Tensor:
    """Relative meta-poses of a robot that drives on and turns here and there ``(1, blocks, 3)``, float64."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(1, blocks, 3, generator=generator, dtype=torch.float64)
    return values * torch.tensor([0.3, 0.1, 0.4]) + torch.tensor([0.8, 0.0, 0.1])
