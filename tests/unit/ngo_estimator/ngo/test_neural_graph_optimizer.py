"""The Neural Graph Optimizer: fresh it is the identity, the paper's form is the paper's, gradients reach everything."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops, LoopSearch
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig, poses_in_blocks
from tests.unit.ngo_estimator.samples import optimized, small_optimizer, small_pair_head, trajectory_inputs

AGGREGATION = PoseAggregationConfig(motion_feature_size=6)
FORMS = ["loops", "smoothed", "gauss_newton", "paper"]


@pytest.mark.parametrize(
    ("form", "blocks"),
    [("loops", 1), ("loops", 2), ("gauss_newton", 2), ("paper", 2), ("paper", 20), ("loops", 20), ("smoothed", 1)],
)
def test_a_fresh_optimizer_without_a_loop_returns_the_odometry_exactly(form: str, blocks: int) -> None:
    inputs = trajectory_inputs(2, 8 * blocks)
    changes = {} if form == "paper" else {"search": LoopSearch(2, 8, 100, 0, 3)}
    result = optimized(small_optimizer(form, **changes), inputs)
    odometry = poses_in_blocks(inputs[0], 8)[:, :, -1]
    assert len(result.meta_relative) == 3
    assert all(torch.equal(relative, odometry) for relative in result.meta_relative)
    assert result.poses.shape == (2, 8 * blocks, 3)
    assert (result.poses - se2.r2g(inputs[0])).abs().max() < 1e-6 * 8 * blocks


def test_a_fresh_optimizer_with_loops_is_the_robust_pose_graph() -> None:
    inputs = trajectory_inputs(2, 160)
    network, graph = (optimized(small_optimizer(form), inputs) for form in ("loops", "gauss_newton"))
    assert torch.allclose(network.poses, graph.poses, atol=1e-5)
    assert (network.poses - se2.r2g(inputs[0])).abs().max() > 1e-3


@pytest.mark.parametrize("form", FORMS)
def test_a_trained_optimizer_moves_poses_and_batches_do_not_matter(form: str) -> None:
    inputs, optimizer = trajectory_inputs(3, 80), small_optimizer(form, trained=True)
    together = optimized(optimizer, inputs)
    assert (together.poses - se2.r2g(inputs[0])).norm(dim=-1).mean() > 1e-3
    for k in range(3):
        alone = optimized(optimizer, tuple(value[k : k + 1] for value in inputs))
        assert torch.allclose(together.poses[k], alone.poses[0], atol=1e-4)
        assert torch.allclose(together.end_covariance()[k], alone.end_covariance()[0], rtol=1e-3, atol=1e-9)


def test_paper_form_is_that_of_the_paper() -> None:
    config = NeuralGraphOptimizerConfig.paper_form(AGGREGATION)
    assert (config.attention, config.loops, config.residual) == ("sum", False, False)
    assert config.dilations == (1,) * 9
    optimizer = small_optimizer("paper")
    convolutions = list(optimizer.convolutions)
    assert len(convolutions) == 9
    assert {(c.kernel_size, c.stride, c.padding, c.dilation) for c in convolutions} == {((3,), (1,), (1,), (1,))}
    assert convolutions[0].in_channels == 2 * 16  # feature and attention, nothing else
    # Nothing of the loops is in it.
    relative, log_std, motion, _ = trajectory_inputs(1, 16)
    result = optimizer(relative, log_std, motion)
    assert result.loops is None and result.loop_weights is None and result.loop_information is None


@pytest.mark.parametrize("attention", ["softmax", "sum"])
def test_attention_is_a_weighting_of_all_poses(attention: str) -> None:
    optimizer = small_optimizer(trained=True, attention=attention)
    features = torch.rand(2, 10, 16)
    weights = optimizer.attend(features, torch.zeros(2, 10, 10))
    assert weights.shape == (2, 10, 10) and weights.min() >= 0.0
    assert torch.allclose(weights.sum(-1), torch.ones(2, 10), atol=1e-5)
    nothing = optimizer.attend(torch.zeros(2, 10, 16), torch.zeros(2, 10, 10))
    assert nothing.isfinite().all()


def test_sum_attention_is_the_papers_for_queries_of_one_sign() -> None:
    optimizer = small_optimizer("paper")
    with torch.no_grad():
        optimizer.query.weight.abs_()
        optimizer.query.bias.zero_()
    features = torch.rand(1, 6, 16)
    c = optimizer.query(features) @ features.mT
    assert torch.allclose(optimizer.attend(features, None), c / c.sum(-1, keepdim=True), atol=1e-5)


def test_an_untrained_step_cannot_pull_attention_but_place_gain_can() -> None:
    optimizer = small_optimizer()
    features, similarity = torch.rand(1, 5, 16), torch.eye(5)[None]
    assert torch.equal(optimizer.attend(features, similarity), optimizer.attend(features, None))
    optimizer.place_gain.fill_(1.0)
    assert optimizer.attend(features, similarity)[0].diagonal().min() > 0.9


def in_double(loops: Loops | None) -> Loops | None:
    if loops is None:
        return None
    values = {name: value for name, value in vars(loops).items() if name in Loops.__dataclass_fields__}
    floating = {n: v.double() for n, v in values.items() if isinstance(v, torch.Tensor) and v.is_floating_point()}
    return replace(loops, **floating)  # type: ignore[arg-type]


@pytest.mark.parametrize("form", ["loops", "gauss_newton", "paper"])
def test_gradients_through_one_iteration_are_those_of_finite_differences(form: str) -> None:
    relative, log_std, motion, codes = trajectory_inputs(1, 48)
    optimizer = small_optimizer(form, trained=True, iterations=1)
    loops = in_double(optimizer.find_loops(relative, codes, small_pair_head()) if optimizer.config.loops else None)
    optimizer = optimizer.double().requires_grad_(True)
    steps = optimizer.aggregate(relative.double(), log_std.double(), motion.double())
    names = ["relative", "std", *(["features"] if steps.features is not None else [])]
    measured = [] if loops is None else [loops.measured, loops.log_scale]
    inputs = [getattr(steps, name).detach().requires_grad_() for name in names]
    inputs += [value.detach().requires_grad_() for value in measured]

    def corrected(*values: torch.Tensor) -> torch.Tensor:
        changed = replace(steps, **dict(zip(names, values, strict=False)))  # type: ignore[arg-type]
        *_, a, b = (*values, *values)
        seen = None if loops is None else replace(loops, measured=a, log_scale=b)
        return optimizer.optimize(changed, seen).meta_relative[-1]

    assert torch.autograd.gradcheck(corrected, tuple(inputs), rtol=1e-3, atol=1e-6)

    # Of all parameters, the derivative along a random direction.
    parameters = [p for name, p in optimizer.named_parameters() if not name.startswith("aggregation.")]
    generator = torch.Generator().manual_seed(1)
    direction = [torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in parameters]
    weights = torch.randn(inputs[0].shape, generator=generator, dtype=torch.float64)

    def loss(length: float) -> torch.Tensor:
        with torch.no_grad():
            for parameter, along in zip(parameters, direction, strict=True):
                parameter.add_(along, alpha=length)
        return (weights * corrected(*(value.detach() for value in inputs))).sum()

    gradients = torch.autograd.grad(loss(0.0), parameters, allow_unused=True)
    exact = sum(float((g * d).sum()) for g, d in zip(gradients, direction, strict=True) if g is not None)
    ahead, behind = loss(1e-6).item(), loss(-2e-6).item()
    assert abs(exact) > 1e-6
    assert exact == pytest.approx((ahead - behind) / 2e-6, rel=1e-4)


def test_fill_among_the_loops_changes_nothing() -> None:
    inputs = trajectory_inputs(1, 40)
    few, many = (
        optimized(small_optimizer(trained=True, search=LoopSearch(2, count, 2, 0)), inputs) for count in (8, 60)
    )
    assert few.loops is not None and many.loops is not None
    assert few.loops.valid.sum() == many.loops.valid.sum() == 5
    assert torch.allclose(few.poses, many.poses, atol=1e-6)
    assert many.loop_weights is not None and not many.loop_weights[~many.loops.valid].any()


def test_loop_weights_are_gates_and_information_is_never_negative() -> None:
    result = optimized(small_optimizer(trained=True), trajectory_inputs(2, 160))
    assert result.loop_weights is not None and result.loop_information is not None
    assert result.loop_weights.min() >= 0.0 and result.loop_weights.max() <= 1.0
    assert result.loop_information.min() >= 0.0 and result.loop_information.isfinite().all()


@pytest.mark.parametrize("form", FORMS)
def test_covariance_of_the_end_is_symmetric_and_positive(form: str) -> None:
    covariance = optimized(small_optimizer(form, trained=True), trajectory_inputs(2, 160)).end_covariance()
    assert covariance.shape == (2, 3, 3) and covariance.dtype == torch.float64
    assert torch.allclose(covariance, covariance.mT, rtol=1e-9)
    assert torch.linalg.eigvalsh(covariance).min() > 0.0


def test_a_certain_loop_is_closed() -> None:
    class Certain(nn.Module):
        """Knows that code k and code k + 40 show one pose."""

        config = small_pair_head().config

        def embed(self, codes: torch.Tensor) -> torch.Tensor:
            return nn.functional.normalize(codes, dim=-1)

        def forward(self, a: torch.Tensor, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
            shape = a.shape[:-1]
            same = (a - b).abs().amax(-1) < 1e-6
            return a.new_zeros(*shape, 3), a.new_full((*shape, 2), -5.0), torch.where(same, 15.0, -20.0)

    # Two rounds on a circle, 40 steps each, by an odometry that turns too little.
    _, log_std, motion, codes = trajectory_inputs(1, 80)
    codes[:, 40:] = codes[:, :40]
    relative = torch.tensor([0.15, 0.0, 0.97 * 2.0 * torch.pi / 40]).expand(1, 80, 3)
    optimizer = small_optimizer(iterations=8, correction_std=(0.1, 0.1, 0.1))
    before = se2.r2g(relative)
    loops = optimizer.find_loops(relative, codes, Certain())  # type: ignore[arg-type]
    after = optimizer(relative, log_std, motion, loops).poses
    later = torch.tensor([47, 55, 63, 71, 79])
    distance = [(poses[0, later] - poses[0, later - 40])[:, :2].norm(dim=-1) for poses in (before, after)]
    assert distance[0].min() > 0.15
    assert distance[1].max() < 0.03


def test_without_a_network_only_gates_and_noise_are_learned() -> None:
    optimizer = small_optimizer("gauss_newton", trained=True)
    assert {name.split(".")[0] for name, _ in optimizer.named_parameters()} == {"loop_gate", "log_scale"}
    relative, log_std, motion, codes = trajectory_inputs(2, 160)
    other = optimized(optimizer, (relative, log_std, torch.rand_like(motion), codes))
    assert torch.equal(optimized(optimizer, (relative, log_std, motion, codes)).poses, other.poses)
