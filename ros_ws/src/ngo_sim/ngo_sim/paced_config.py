"""How a simulator node paces and records what it publishes."""

from __future__ import annotations

from dataclasses import dataclass

from ngo_common.settings import FramedSettings, setting, topics

MOST = 2**31 - 1

FLOW_CONTROL = (
    "Stamped topics of the nodes that process the frames. At rate 0 the simulator stays at most max_in_flight frames "
    "ahead of the slowest one that has a publisher."
)


@dataclass(frozen=True)
class PacedConfig(FramedSettings):
    """Settings of every simulator node; its frames are images, or scans."""

    seed: int = setting(
        0,
        "Seed of everything random: the world and its looks, start, people, doors, noise and driver.",
        minimum=0,
        maximum=MOST,
    )
    rate: float = setting(
        10.0,
        "Frames (scans or images) a second of wall time; 0: as fast as the subscribers take them, none lost.",
        minimum=0.0,
        maximum=10_000.0,
    )
    frames: int = setting(
        0, "Number of frames after which the node ends with exit code 0; 0: endless.", minimum=0, maximum=MOST
    )
    wait_for_subscribers: int = setting(
        0, "Number of subscribers of the image or scan that the first frame waits for.", minimum=0, maximum=100
    )
    wait_for_flow_control: bool = setting(
        False, "Whether the first frame waits until each of flow_control_topics has a publisher."
    )
    flow_control_topics: tuple[str, ...] = topics(("odom", "ngo/pose"), FLOW_CONTROL)
    max_in_flight: int = setting(
        4, "Number of frames that the slowest flow control topic may be behind at rate 0.", minimum=1, maximum=1000
    )
    stall_timeout_s: float = setting(
        10.0,
        "Wall time without a message on the flow control topics after which the simulator takes its frames for lost "
        "and goes on, at rate 0; 0: never.",
        minimum=0.0,
        maximum=3600.0,
    )
    record: str = setting(
        "",
        "File for a recording of everything that is published: a new .mcap file, or a new folder for the layout of "
        "rosbag2; empty: no recording.",
    )
