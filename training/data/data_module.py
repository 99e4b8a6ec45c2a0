"""Batches of a training for Lightning: a stream for each epoch, and validation batches that are made once."""

from collections.abc import Callable
from functools import cached_property

import lightning
from torch.utils.data import DataLoader, IterableDataset

from training.data.batches import Batch, Share
from training.data.streams import loader

EpochStream = Callable[[int, Share], IterableDataset[Batch]]
"""Makes the stream of an epoch, for one of the processes that train together."""


class StreamedData(lightning.LightningDataModule):
    """Epochs of a stream, made by ``workers`` processes, and batches to be measured on, made when they are needed."""

    def __init__(self, stream: EpochStream, validation: Callable[[], list[Batch]], workers: int) -> None:
        super().__init__()
        self._stream, self._make_validation, self._workers = stream, validation, workers

    def train_dataloader(self) -> DataLoader[Batch]:
        assert self.trainer is not None
        share = Share(self.trainer.global_rank, self.trainer.world_size)
        return loader(self._stream(self.trainer.current_epoch, share), self._workers)

    def val_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.validation, batch_size=None)  # type: ignore[arg-type]

    @cached_property
    def validation(self) -> list[Batch]:
        """The batches that each epoch is measured on."""
        return self._make_validation()
