"""Features of tracks of recordings, as ``training.data.features`` makes them of simulated episodes."""

import numpy as np
from torch import Tensor

from training.data.batches import mirrored, seen_from_first
from training.data.data_source import Domain
from training.data.features import Networks, step_features
from training.recordings.recording_streams import known_side_information, side_information
from training.recordings.recording_tracks import Track


def features_of_track(domain: Domain, track: Track, networks: Networks, mirror: bool = False) -> dict[str, np.ndarray]:
    """Features of a track of a recording or of its mirror image, as of ``step_features``."""
    side = known_side_information(domain, side_information(track, slice(None)))
    poses = track.poses_xyyaw
    if mirror:
        side, poses = mirrored(side), seen_from_first(poses) * np.array([1.0, -1.0, -1.0])

    def frames(index: slice) -> Tensor:
        return track.frames(index).flip(-2) if mirror else track.frames(index)

    return step_features(frames, side, poses, networks)
