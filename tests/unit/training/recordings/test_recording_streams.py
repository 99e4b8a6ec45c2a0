"""Batches from recordings: consecutive frames, places seen again, and stretches for the optimizer."""

import dataclasses

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_recordings.errors import RecordingError
from tests.unit.training import drives
from training.data.batches import Share, mirrored
from training.recordings.recording_source import RecordedArguments, RecordedData, open_recorded
from training.recordings.recording_streams import (
    RecordedPairs,
    RecordedPlaces,
    revisited,
    windows,
)

FRAMES = 700


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> RecordedData:
    folder = tmp_path_factory.mktemp("drives")
    paths = tuple(folder / f"drive_{k}.mcap" for k in range(2))
    for k, path in enumerate(paths):
        drives.write(path, FRAMES, seed=k)
    return open_recorded(RecordedArguments(data=paths), folder)


def test_pairs_are_consecutive_frames_and_their_motion_every_second_batch_in_a_mirror(data: RecordedData) -> None:
    tracks = data.tracks("train")
    stream = RecordedPairs(data.domain, tracks, epoch=0, datapoints=10**6, batch_size=64)
    batches = list(stream)
    assert len(batches) == len(stream) == 2 * len(stream.index) // stream.batch_size
    step = se2.between(*(torch.from_numpy(drives.poses(2, 0))[k] for k in (0, 1))).float()
    seen = set()
    for count, batch in enumerate(batches):
        true = mirrored(batch) if count % 2 else batch
        torch.testing.assert_close(true["relative"], step.expand(stream.batch_size, 3), atol=1e-6, rtol=0.0)
        for earlier, later in zip(true["earlier"].numpy(), true["later"].numpy(), strict=True):
            seen.add((earlier.tobytes(), later.tobytes()))
    consecutive = {
        (drives.picture(k, 0).tobytes(), drives.picture(k + 1, 0).tobytes())
        for track in tracks
        for k in range(track.first, track.first + len(track) - 1)
    }
    assert seen <= consecutive and len(seen) > 0.9 * len(consecutive)


def test_time_runs_backwards_in_a_quarter_of_the_batches_where_the_robot_does(data: RecordedData) -> None:
    domain = dataclasses.replace(data.domain, reverses=True)
    tracks = data.tracks("train")
    later, earlier = (torch.from_numpy(drives.poses(2, 0))[k] for k in (1, 0))
    back = se2.between(later, earlier).float()
    batches, forward = (list(RecordedPairs(d, tracks, 0, 512, 32)) for d in (domain, data.domain))
    reversed_ones = [k for k in range(len(batches)) if float(batches[k]["relative"][:, 0].mean()) < 0.0]
    assert reversed_ones == [k for k in range(len(batches)) if k % 8 in (2, 5)]
    for k in reversed_ones:
        true = mirrored(batches[k]) if k % 2 else batches[k]
        torch.testing.assert_close(true["relative"], back.expand(len(true["relative"]), 3), atol=1e-6, rtol=0.0)
        assert torch.equal(batches[k]["earlier"], forward[k]["later"])
        assert torch.equal(batches[k]["later"], forward[k]["earlier"])


def test_an_epoch_follows_from_its_number_and_processes_share_it(data: RecordedData) -> None:
    def epoch(number: int, share: Share = Share()) -> list[bytes]:  # noqa: B008
        return [
            b["earlier"].numpy().tobytes()
            for b in RecordedPairs(data.domain, data.tracks("train"), number, 512, 32, share)
        ]

    assert epoch(3) == epoch(3) != epoch(4)
    assert sorted(epoch(3, Share(0, 2)) + epoch(3, Share(1, 2))) == sorted(epoch(3))


def test_places_are_seen_again_after_a_round(data: RecordedData) -> None:
    found = revisited(data.domain, data.tracks("train"))
    (one,) = found
    for (first_track, first), (second_track, second) in one.pairs[::50]:
        a, b = (one.tracks[t].poses_xyyaw[f] for t, f in ((first_track, first), (second_track, second)))
        assert np.hypot(*(a - b)[:2]) <= data.domain.place_radius_m
        along = (one.tracks[second_track].first + second - one.tracks[first_track].first - first) * drives.STEP_M
        assert along >= 10.0 * data.domain.place_radius_m - 1e-6
    places = RecordedPlaces(data, 8, 16, 2)
    assert places.too_few is None
    batch = next(iter(places.pairs(0, Share())))
    distance = (batch["poses"][:, 0] - batch["poses"][:, 1])[:, :2].norm(dim=1)
    assert len(batch["a"]) == 16 and float(distance.max()) <= data.domain.place_radius_m


def test_too_few_places_are_told(data: RecordedData) -> None:
    far = dataclasses.replace(data, domain=dataclasses.replace(data.domain, place_radius_m=0.001))
    assert "0 frames of the training part show a place" in str(RecordedPlaces(far, 8, 16, 2).too_few)


def test_stretches_are_equally_long_whole_blocks_and_mirrored(data: RecordedData) -> None:
    found = windows(data.domain, data.tracks("train"), 1000, 64, 8)
    assert found.steps % 8 == 0 and len(found.cuts) >= 8
    assert {len(track) for track, _ in found.cuts} == {found.steps + 1}
    assert sum(mirror for _, mirror in found.cuts) == len(found.cuts) / 2
    with pytest.raises(RecordingError, match="expected 5000 or more"):
        windows(data.domain, data.tracks("train"), 9000, 5000, 8)
