"""Which topics of a recording are used for what."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ngo_recordings.recording import Recording


@dataclass(frozen=True)
class GroundTruth:
    """Where the true poses come from: exactly one of a topic, two TF frames, or a file.

    topic: of nav_msgs/Odometry or geometry_msgs/PoseStamped (also PoseWithCovarianceStamped). tf: parent and child
    frame, looked up through the tree. tum: file in the TUM format, stamps of the same clock as the images'.
    """

    topic: str | None = None
    tf: tuple[str, str] | None = None
    tum: Path | None = None

    @classmethod
    def parse(cls, text: str) -> GroundTruth:
        """From the command line: `tf:PARENT:CHILD`, a file ending in .tum or .txt, or else a topic."""
        raise NotImplementedError

    def __str__(self) -> str:
        raise NotImplementedError


@dataclass(frozen=True)
class TopicArguments:
    """What a person says about topics on the command line; a field that is not given is chosen, `none` uses nothing."""

    image: str | None = None
    """Topic of the pictures or scans: Image, CompressedImage or LaserScan."""
    depth: str | None = None
    """Topic of a depth image (32FC1, 16UC1) that becomes one more channel of the pictures."""
    action: str | None = None
    """Topic of the actions, ngo_msgs/DiscreteAction."""
    twist: str | None = None
    """Topic of the velocity as side information: Twist, TwistStamped or Odometry."""
    ground_truth: str | None = None
    """True poses: a topic of Odometry or PoseStamped, tf:PARENT:CHILD, or a file in the TUM format."""
    tolerance_s: float = 0.05
    """How far the stamps of what belongs together may be apart."""


@dataclass(frozen=True)
class RecordingTopics:
    """What is used for what; None: nothing. `choose_topics` makes one that fits the recording.

    image: Image, CompressedImage or LaserScan. depth: Image of depth, one more channel. action: DiscreteAction. twist:
    Twist, TwistStamped or Odometry. tolerance_s: how far the stamps of what belongs together may be apart.
    """

    image: str
    depth: str | None = None
    action: str | None = None
    twist: str | None = None
    ground_truth: GroundTruth | None = None
    tolerance_s: float = 0.05


def choose_topics(recording: Recording, given: TopicArguments | None = None) -> RecordingTopics:
    """What is given, and for the rest what the types and names of the recording's topics make clear.

    Raises:
        RecordingError: a topic that is given is not there or of another type, or the image topic is not clear.
    """
    raise NotImplementedError
