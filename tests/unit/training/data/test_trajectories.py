"""What the optimizer trains on: stretches of stored trajectories and their loop candidates."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from tests.unit.ngo_estimator.rooms import CAMERA, camera_pair_head, drive_with_a_camera
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head
from tests.unit.training.stores import SHAPES
from training.data.batches import Share
from training.data.trajectories import RandomStretches, StoredTrajectories, correction_scale, loops_of

SEARCH = LoopSearch(per_pose=2, most=10, min_separation=1, min_apart=0)


def stored(store: Path, search: LoopSearch | None = SEARCH) -> StoredTrajectories:
    return StoredTrajectories([store], search, small_pair_head(), 8)


@pytest.mark.parametrize("start", [0, 8, 24])
def test_a_stretch_is_seen_from_the_frame_before_it_with_a_continuous_heading(store: Path, start: int) -> None:
    batch = stored(store, None).batch([1, 4], start, 16)
    steps = {name: size for name, size in SHAPES.items() if name not in ("codes", "origin_code")}
    expected_shapes = {name: (2, 16, size) for name, size in {**steps, "odometry": 3}.items()}
    assert {name: value.shape for name, value in batch.items()} == expected_shapes
    assert all(value.dtype == torch.float32 for value in batch.values())
    expected = se2.r2g(torch.tensor([0.1, 0.0, 0.3]).expand(2, 16, 3))
    assert torch.allclose(batch["truth"], expected, atol=1e-4)
    assert loops_of(batch) is None


def test_loops_are_those_that_the_optimizer_finds_and_are_found_once(store: Path) -> None:
    data = stored(store)
    loops = loops_of(data.batch([3, 7], 0, 40))
    arrays = [torch.from_numpy(np.load(store / f"{name}.npy")[[3, 7]]).float() for name in ("relative", "codes")]
    expected = small_optimizer(search=SEARCH).find_loops(*arrays, small_pair_head())
    assert loops is not None
    assert torch.equal(loops.valid, expected.valid) and torch.allclose(loops.embeddings, expected.embeddings, atol=1e-6)
    for name in ("start", "end", "frame", "measured", "log_scale", "logit", "similarity"):
        assert torch.allclose(getattr(loops, name)[loops.valid], getattr(expected, name)[loops.valid], atol=1e-5), name
    (kept,) = (store / "loops").iterdir()
    kept.write_bytes(kept.read_bytes())
    changed = kept.stat().st_mtime_ns
    stored(store)
    assert kept.stat().st_mtime_ns == changed


def test_a_stretch_keeps_the_loops_within_it_and_counts_from_its_start(store: Path) -> None:
    data = stored(store)
    whole, part = loops_of(data.batch([2], 0, 40)), loops_of(data.batch([2], 8, 24))
    assert whole is not None and part is not None
    inside = whole.valid & (whole.start >= 1) & (whole.end < 4)
    assert inside.any() and not inside.all()
    assert torch.equal(part.valid, inside)
    assert torch.equal(part.start[inside], whole.start[inside] - 1)
    assert torch.equal(part.end[inside], whole.end[inside] - 1)
    assert torch.equal(part.frame[inside], whole.frame[inside] - 8)
    assert part.end.max() < 3 and part.embeddings.shape[1] == 3


def test_the_scale_of_corrections_is_the_error_of_the_odometry_over_a_meta_pose(store: Path) -> None:
    x, y, yaw = correction_scale(stored(store, None))
    odometry, truth = (se2.r2g(torch.tensor([0.1, 0.0, turn]).expand(8, 3))[-1] for turn in (0.29, 0.3))
    assert (x, y, yaw) == pytest.approx((odometry - truth).abs().tolist(), rel=1e-2)
    assert yaw == pytest.approx(0.08, rel=1e-3)


def test_batches_are_a_function_of_seed_epoch_and_process(store: Path) -> None:
    data = stored(store)
    which = ((2, 0), (2, 0), (3, 0), (2, 1))
    streams = [RandomStretches(data, 6, 4, 0, epoch, Share(rank, 2)) for epoch, rank in which]
    epochs = [list(stream) for stream in streams]
    assert [len(epoch) for epoch in epochs] == [len(stream) for stream in streams] == [6, 6, 6, 6]
    lengths = {batch["relative"].shape for epoch in epochs for batch in epoch}
    assert lengths <= {(4, 40, 3), (4, 16, 3), (4, 8, 3)} and len(lengths) > 1
    first, again, *others = epochs
    assert all(torch.equal(a["motion"], b["motion"]) for a, b in zip(first, again, strict=True))
    for other in others:
        assert not all(a["motion"].equal(b["motion"]) for a, b in zip(first, other, strict=True))


def test_where_overlaps_are_looked_for_a_stretch_has_its_ranges(tmp_path: Path) -> None:
    relative, log_std, codes, truth = (value.numpy() for value in drive_with_a_camera(48))
    arrays = {"relative": relative, "log_std": log_std, "codes": codes.astype(np.float16), "truth": truth}
    arrays |= {"origin_code": arrays["codes"][:, :1], "motion": np.zeros((1, 48, 6), np.float16)}
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    (tmp_path / "done.0of1.json").write_text("[0]")
    search = LoopSearch(2, 8, 3, 0, 1, registrations=5, overlaps=20)
    data = StoredTrajectories([tmp_path], search, camera_pair_head(), 8)
    batch = data.batch([0], 16, 24)
    loops = loops_of(batch, CAMERA)
    assert loops is not None and loops.scans is not None and loops.scans.registration is CAMERA
    np.testing.assert_array_equal(loops.scans.ranges, arrays["codes"][:, 16:40, 12:].astype(np.float32))
    without = loops_of(batch)
    assert without is not None and without.scans is None
    optimizer = small_optimizer("gauss_newton", iterations=3, search=search)
    result = optimizer(batch["relative"], batch["log_std"], batch["motion"], loops)
    assert result.loops.start.shape[1] > loops.start.shape[1]
