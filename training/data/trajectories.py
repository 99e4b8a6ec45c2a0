"""Stretches of stored trajectories with their loop candidates, for smoother and optimizer."""

import contextlib
import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import IterableDataset

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import RegistrationConfig, Scans
from ngo_estimator.loops.loop_closure import Loops, LoopSearch, find_loops
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.pose_aggregation import poses_in_blocks
from ngo_estimator.ngo.registered_odometry import registered_steps
from training.data.batches import ALL, Batch, Share
from training.data.data_module import StreamedData
from training.data.feature_store import open_store

_LOOP = "loop_"  # a batch holds the fields of its Loops under their names with this in front
_TOGETHER = 8  # trajectories that are searched for loops, or measured, at once
_FEWEST_BATCHES = 8  # of an epoch
_STEPWISE = ("relative", "log_std", "motion", "truth")
_REGISTERED = ("relative", "log_std")
_RANGES = "ranges"


class StoredTrajectories:
    """The trajectories of one or more feature stores, memory-mapped, and the loop candidates of each.

    The candidates do not depend on what is trained: they are found once, and kept in ``STORE/loops/``.
    """

    def __init__(self, stores: list[Path], search: LoopSearch | None, pair_head: PairHead, block: int) -> None:
        self.parts = []
        for store in stores:
            arrays = open_store(store)
            found = {} if search is None else found_loops(store, arrays, search, pair_head, block)
            odometry = {"odometry": arrays["relative"]}
            arrays = {**arrays, **{name: found.pop(name) for name in _REGISTERED if name in found}}
            codes = {"codes": arrays["codes"]} if search is not None and search.overlaps else {}
            self.parts.append({**{name: arrays[name] for name in _STEPWISE}, **found, **odometry, **codes})
        self._code_size = pair_head.config.code_size
        self.block = block
        self.steps = min(part["relative"].shape[1] for part in self.parts) // block * block
        self.index = [(p, row) for p, part in enumerate(self.parts) for row in range(len(part["relative"]))]

    def __len__(self) -> int:
        return len(self.index)

    def batch(self, chosen: list[int], start: int, length: int) -> Batch:
        """Trajectories from step ``start`` on, both multiples of the block; ``truth`` is seen from the frame before.

        Holds ``relative``, ``log_std``, ``motion`` and ``truth`` ``(batch, length, ...)``, float32, and the fields of
        ``Loops``, which ``loops_of`` puts together. ``relative`` and ``log_std`` are as the optimizer takes them, where
        it registers scans, and ``odometry`` ``(batch, length, 3)`` what they were before. With overlaps to be looked
        for, ``ranges`` ``(batch, length, rays)`` are of the frame after each step.
        """
        rows = [self._row(*self.index[k], start, length) for k in chosen]
        return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}

    def _row(self, part: int, row: int, start: int, length: int) -> Batch:
        arrays = self.parts[part]
        stepwise = (*_STEPWISE, "odometry")
        values = {name: torch.from_numpy(arrays[name][row, start : start + length].copy()) for name in stepwise}
        if start:
            values["truth"] = se2.between(torch.from_numpy(arrays["truth"][row, start - 1].copy()), values["truth"])
        # The continuous heading of a whole trajectory, which the network's sums of turns are compared with.
        values["truth"][..., 2] = torch.from_numpy(np.unwrap(values["truth"][..., 2].numpy()))
        values = {name: value.float() for name, value in values.items()}
        loops = {name: torch.from_numpy(array[row].copy()) for name, array in arrays.items() if name.startswith(_LOOP)}
        frames = {}
        if "codes" in arrays:
            ranges = arrays["codes"][row, start : start + length, self._code_size :]
            frames[_RANGES] = torch.from_numpy(ranges.astype(np.float32))
        return {**values, **frames, **_cropped(loops, start // self.block, length // self.block, self.block)}


def loops_of(batch: Batch, registration: RegistrationConfig | None = None) -> Loops | None:
    """The loop candidates in a batch, None without; ``registration`` is that of the ranges, if there are any."""
    fields = {name.removeprefix(_LOOP): value for name, value in batch.items() if name.startswith(_LOOP)}
    scans = None if registration is None or _RANGES not in batch else Scans(batch[_RANGES], registration)
    return Loops(**{**fields, "scans": scans}) if fields else None  # type: ignore[arg-type]


def found_loops(
    store: Path, arrays: dict[str, np.ndarray], search: LoopSearch, pair_head: PairHead, block: int
) -> dict[str, np.ndarray]:
    """The fields of ``Loops`` for all trajectories of a store, found now or when they were first asked for.

    Where the odometry is registered, too, also ``relative`` and ``log_std`` ``(trajectories, steps, 3)`` after that.
    """
    registration = pair_head.config.registration
    search = dataclasses.replace(search, overlaps=0)  # which are looked for under poses
    made_with = [*dataclasses.astuple(search), block]
    if search.registrations and registration is not None:
        made_with += dataclasses.astuple(registration)
    path = store / "loops" / ("-".join(str(value) for value in made_with) + ".npz")
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        whole = arrays["relative"].shape[1] // block * block
        parts: list[Loops] = []
        odometry: list[tuple[torch.Tensor, ...]] = []
        with torch.inference_mode():
            for rows in np.array_split(np.arange(len(arrays["relative"])), -(-len(arrays["relative"]) // _TOGETHER)):
                names = ("relative", "log_std", "codes", "origin_code")
                relative, log_std, codes, origin = (torch.from_numpy(arrays[n][rows, :whole]).float() for n in names)
                steps = registered_steps(pair_head, relative, log_std, codes, block, search.registrations, origin[:, 0])
                odometry.append(steps)
                parts.append(find_loops(pair_head, codes, poses_in_blocks(steps[0], block), search))
        fields = [f.name for f in dataclasses.fields(Loops) if isinstance(getattr(parts[0], f.name), torch.Tensor)]
        values = {_LOOP + name: torch.cat([getattr(part, name) for part in parts]).numpy() for name in fields}
        if search.registrations and pair_head.config.registers_odometry:
            columns = zip(*odometry, strict=True)
            values |= {name: torch.cat(steps).numpy() for name, steps in zip(_REGISTERED, columns, strict=True)}
        partial = path.with_name(f"{path.name}.{os.getpid()}.npz")
        np.savez(partial, **values)  # type: ignore[arg-type]
        with contextlib.suppress(FileExistsError):
            os.link(partial, path)
        partial.unlink()
    with np.load(path) as found:
        return dict(found)


def _cropped(loops: Batch, first: int, blocks: int, block: int) -> Batch:
    """Loops between the meta-poses ``first .. first + blocks - 1``, counted from ``first``; others become fill."""
    if not loops:
        return loops
    start, end = loops[_LOOP + "start"], loops[_LOOP + "end"]
    inside = loops[_LOOP + "valid"] & (start >= first) & (end < first + blocks)
    return {
        **loops,
        _LOOP + "valid": inside,
        _LOOP + "start": torch.where(inside, start - first, 0),
        _LOOP + "end": torch.where(inside, end - first, 0),
        _LOOP + "frame": torch.where(inside, loops[_LOOP + "frame"] - first * block, 0),
        _LOOP + "embeddings": loops[_LOOP + "embeddings"][first : first + blocks],
    }


class RandomStretches(IterableDataset[Batch]):
    """Batches of random stretches of random trajectories; an epoch is a function of its number and the seed.

    Processes that train together each get batches of their own.
    """

    def __init__(
        self, data: StoredTrajectories, batches: int, batch_size: int, seed: int, epoch: int, share: Share = ALL
    ) -> None:
        if batch_size > len(data):
            raise ValueError(f"batch_size is {batch_size}; expected at most {len(data)}, the trajectories in the store")
        self.data, self.batches, self.batch_size = data, batches, batch_size
        self.seed, self.epoch, self.share = seed, epoch, share

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Batch]:
        rng = np.random.default_rng([self.seed, self.epoch, self.share.rank])
        data = self.data
        for _ in range(self.batches):
            # Short ones too: online, every trajectory is short at first.
            length = int(rng.choice([data.steps, data.steps, data.steps // 2, data.steps // 4]))
            length = length // data.block * data.block
            chosen = np.sort(rng.choice(len(data), self.batch_size, replace=False))
            start = int(rng.integers(0, (data.steps - length) // data.block + 1)) * data.block
            yield data.batch(chosen.tolist(), start, length)


def stretch_data(
    train: StoredTrajectories,
    validation: StoredTrajectories,
    steps: int,
    batch_size: int,
    seed: int,
    few: bool = False,
) -> StreamedData:
    """``RandomStretches`` to train on, and whole trajectories to be measured on.

    Args:
        steps, batch_size: batches in an epoch, and stretches in a batch.
        few: whether the trajectories are few, as of recordings: then a batch has at most as many stretches as there
            are trajectories, and an epoch a batch for each, but ``_FEWEST_BATCHES`` at least.
    """
    if few:
        steps, batch_size = min(steps, max(_FEWEST_BATCHES, len(train))), min(batch_size, len(train))

    def whole() -> list[Batch]:
        rows = np.array_split(np.arange(len(validation)), max(1, len(validation) // _TOGETHER))
        return [validation.batch(chosen.tolist(), 0, validation.steps) for chosen in rows]

    return StreamedData(
        lambda epoch, share: RandomStretches(train, steps, batch_size, seed, epoch, share), whole, workers=0
    )


def rmse_figures(name: str, poses: torch.Tensor, truth: torch.Tensor) -> dict[str, torch.Tensor]:
    """Mean RMSE of trajectories ``(batch, steps, 3)``: ``NAME_m`` of positions, ``NAME_deg`` of headings."""
    error = poses - truth
    position = error[..., :2].square().sum(-1).mean(1).sqrt()
    heading = error[..., 2].square().mean(1).sqrt().rad2deg()
    return {f"{name}_m": position.mean(), f"{name}_deg": heading.mean()}


def correction_scale(data: StoredTrajectories, steps: int | None = None) -> tuple[float, float, float]:
    """Root mean square (m, m, rad) of the odometry's error over so many steps; None: over a meta-pose."""
    steps = data.block if steps is None else steps
    total, count = torch.zeros(3), 0
    for k in range(len(data)):
        batch = data.batch([k], 0, data.steps // steps * steps)
        truth = se2.g2r(batch["truth"][:, steps - 1 :: steps])
        error = se2.wrapped(poses_in_blocks(batch["relative"], steps)[..., -1, :] - truth).square()
        total, count = total + error.sum(dim=(0, 1)), count + error.shape[1]
    x, y, yaw = (total / count).sqrt().tolist()
    return x, y, yaw
