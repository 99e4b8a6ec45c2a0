"""Settings of the loops of pictures, and of the graph that they close."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class PictureLoopConfig:
    """How loops of key pictures are found."""

    # Words of the vocabulary, and key pictures that it is made of: the first ones of the place itself.
    words: int = 32
    vocabulary_pictures: int = 12
    # Newest key pictures that are kept: with older ones no loop is found.
    most_pictures: int = 3000
    # Newest of them that are no candidates.
    recent: int = 6
    # Candidates that are verified for each key picture: so many of the most alike ones near which the robot may be.
    candidates: int = 4
    looked_at: int = 20
    # Deviations of the graph within which the robot may be, and how far apart pictures of one place are taken (m).
    deviations: float = 4.0
    # Times that a loop must be likelier where it is, as the graph expects it, than anywhere on the map.
    likelier: float = 100.0
    apart_m: float = 3.0
    # The second best match must be so many times as far away: a smaller ratio accepts fewer.
    ratio: float = 0.85
    # Samples of RANSAC.
    samples: int = 150
    # Fewest matches that agree, and how large a share of all they are.
    least_inliers: int = 18
    least_share: float = 0.35
    # Fewest points of known range, and the share of them that agree: they tell the scale.
    least_ranged: int = 8
    ranged_share: float = 0.6
    # Turn by which a loop may differ from the graph besides the deviations, rad.
    turn_rad: float = 0.05
    # Deviations that ranges and heights share: of the scale, and of the camera's height (m).
    scale_std: float = 0.05
    rise_std: float = 0.2
    # Factor on deviations of the fit, the least ones (m, rad), and those beyond which it is no loop.
    std_factor: float = 3.0
    least_m: float = 0.03
    least_rad: float = 0.006
    most_m: float = 0.5
    most_rad: float = 0.08


@dataclass(frozen=True)
class PictureGraphConfig:
    """The graph of key pictures."""

    loops: PictureLoopConfig = field(default_factory=PictureLoopConfig)
    # Deviation of the share by which the robot's odometry counts all ways wrong.
    way_share: float = 0.02
    # Key pictures for which a loop waits at most before all are optimised.
    keys_between: int = 2
