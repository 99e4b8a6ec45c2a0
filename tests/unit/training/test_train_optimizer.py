"""What an optimizer is made of in each world, unless it is said otherwise."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ngo_estimator.checkpoint import OPTIMIZER, load_optimizer, load_place, load_smoother, save_checkpoint
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from tests.unit.ngo_estimator.rooms import CAMERA, camera_pair_head, drive_with_a_camera
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head, trajectory_inputs
from training.common.records import WEIGHTS, RunError
from training.data.worlds import WORLDS, world_named
from training.train_optimizer import (
    Arguments,
    OptimizerTraining,
    begun_optimizer,
    config_of,
    main,
    trajectory_loss,
    with_choices,
)


def chosen(given: Arguments, world: str) -> tuple[bool | None, int | None, int | None, int | None]:
    """Smoothing, loops a pose, loops and epochs of a training."""
    arguments = with_choices(given, world_named(world))
    return arguments.smoothing, arguments.loops_per_pose, arguments.max_loops, arguments.epochs


@pytest.mark.parametrize("world", WORLDS)
def test_the_shipped_optimizers_are_made_as_their_world_says(world: str) -> None:
    shipped = load_optimizer(WEIGHTS / world, world)[0].config
    # What picks the loops of doom on validation maps trains no network, and chooses how to search (tune_doom.py).
    arguments = Arguments(world=world, form="gauss_newton" if world == "doom" else "loops")
    made = config_of(arguments, world_named(world), shipped.correction_std, shipped.smoother)  # type: ignore[arg-type]
    if world == "doom":
        made = replace(made, search=shipped.search)
    assert replace(made, covariance_scale=shipped.covariance_scale) == shipped
    # Doom's place codes got their ranges as maze3d's have them, after their training (train_ranges.py).
    ranges = "maze3d" if world == "doom" else world
    assert load_place(WEIGHTS / world, world)[0].config.registration == world_named(ranges).registration
    assert (shipped.smoother is not None) == chosen(arguments, world)[0]
    if shipped.smoother is not None:
        load_smoother(WEIGHTS / world, world)  # for whoever trains an optimizer anew; of the local network beside it


def test_an_optimizer_to_begin_with_does_without_what_is_not_there(tmp_path: Path) -> None:
    search = LoopSearch(2, 8, 2, 0, 3, registrations=5)
    optimizer = small_optimizer("smoothed", trained=True, search=search)
    save_checkpoint(tmp_path / f"{OPTIMIZER}.safetensors", optimizer, OPTIMIZER, "maze3d", {})
    assert begun_optimizer(tmp_path, None, registers=True).config.registrations == 5
    begun = begun_optimizer(tmp_path, None, registers=False)
    assert begun.config == replace(optimizer.config, smoother=None, search=replace(search, registrations=0))
    kept = {name: value for name, value in optimizer.state_dict().items() if not name.startswith("smoother.")}
    assert all(torch.equal(begun.state_dict()[name], value) for name, value in kept.items())


def test_smoothing_of_odometry_that_is_registered_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="smoothing is asked for in maze2d, whose odometry is registered"):
        main(Arguments(world="maze2d", smoothing=True, runs=tmp_path))


def test_what_is_trained_looks_for_overlaps() -> None:
    search = LoopSearch(2, 8, 3, 0, 1, registrations=5, overlaps=20)
    optimizer = small_optimizer("gauss_newton", iterations=5, search=search)
    relative, log_std, codes, _ = drive_with_a_camera(160)
    loops = optimizer.find_loops(relative, codes, camera_pair_head())
    motion = torch.zeros(1, 160, 6)
    batch = {"relative": relative, "log_std": log_std, "motion": motion, "ranges": codes[..., 12:]}
    batch |= {f"loop_{k}": v for k, v in vars(loops).items() if isinstance(v, torch.Tensor)}
    expected = optimizer(relative, log_std, motion, loops)
    assert expected.loops.start.shape[1] == loops.start.shape[1] + 20
    training = OptimizerTraining(Arguments(world="maze3d", epochs=4), optimizer, world_named("maze3d"), CAMERA)
    found = training(batch)
    torch.testing.assert_close(found.meta_relative, expected.meta_relative)
    torch.testing.assert_close(found.poses, expected.poses)


@pytest.mark.parametrize("form", ["loops", "paper"])
def test_all_iterations_are_trained_from_the_first_epoch(form: str) -> None:
    optimizer, world = small_optimizer(form, trained=True), world_named("maze3d")
    relative, log_std, motion, codes = trajectory_inputs(2, 160)
    loops = optimizer.find_loops(relative, codes, small_pair_head()) if form == "loops" else None
    batch = {"relative": relative, "log_std": log_std, "motion": motion, "truth": se2.r2g(1.1 * relative)}
    if loops is not None:
        batch |= {f"loop_{k}": v for k, v in vars(loops).items() if isinstance(v, torch.Tensor)}
    steps = optimizer(relative, log_std, motion, loops).meta_relative
    assert len(steps) == 3
    scales = optimizer.correction_std, world.loss_scale_m, world.loss_scale_rad
    expected = trajectory_loss(steps, batch["truth"][:, 7::8], *scales)
    training = OptimizerTraining(Arguments(world="maze3d", epochs=4), optimizer, world)
    torch.testing.assert_close(training.training_step(batch, 0), expected)
    assert not torch.allclose(expected, trajectory_loss(steps[:1], batch["truth"][:, 7::8], *scales))
