"""How a simulator node runs a world: its settings, where their descriptions come from, and the stamps of its frames."""

from __future__ import annotations

import dataclasses
import inspect
import re
from dataclasses import dataclass, field
from typing import Any

from ngo_sim.driver_choice import DRIVER_NAMES

_LIMITS = re.compile(r" \[(.+)\]$")  # at the end of a comment behind a field


def _setting(
    default: Any,
    text: str,
    low: float | None = None,
    high: float | None = None,
    *,
    changeable: bool = False,
    choices: tuple[str, ...] = (),
    alias: str = "",
) -> Any:
    """A field with its description and what is allowed, for the validation below and for ROS parameter descriptors.

    alias: another name under which it may be given.
    """
    metadata = {"description": text, "low": low, "high": high, "changeable": changeable, "choices": choices}
    return field(default=default, metadata={**metadata, "alias": alias})


@dataclass(frozen=True)
class SimulatorConfig:
    """How a simulator node drives a world and publishes it; the world itself has a config of its own.

    Every field says in its metadata what it means, its range and whether it may change while the node runs.
    """

    seed: int = _setting(0, "Maze, textures, start, noise and driver are functions of this number.", 0, 2**31 - 1)
    rate: float = _setting(
        10.0,
        "Frames a second of wall time; 0: as fast as the subscribers take them, none lost.",
        0.0,
        10_000.0,
        changeable=True,
    )
    driver: str = _setting(
        "auto",
        "Who chooses the actions: paths to the corners, paths to random goals, the straights that promise most "
        "distance, a network trained to travel far, an explorer without a plan, chance, or nobody but action_command; "
        "auto: corners in 2D, random_goals in 3D, explorer on a Doom map. It may also be given as policy.",
        choices=("auto", *DRIVER_NAMES, "none"),
        alias="policy",
    )
    frames: int = _setting(0, "Frames to publish before the node ends with exit code 0; 0: endless.", 0, 2**31 - 1)
    wait_for_subscribers: int = _setting(0, "Subscribers that the image must have before frame 0 is published.", 0, 100)
    wait_for_flow_control: bool = _setting(
        False, "Wait before frame 0 until each of flow_control_topics has a publisher."
    )
    flow_control_topics: tuple[str, ...] = _setting(
        ("odom", "ngo/pose"),
        "Stamped topics of those who take the frames; at rate 0 the simulator stays at most "
        "max_in_flight frames ahead of the slowest of them that has a publisher.",
    )
    max_in_flight: int = _setting(4, "Frames at rate 0 that the slowest flow control topic may be behind.", 1, 1000)
    stall_timeout_s: float = _setting(
        10.0,
        "Wall time at rate 0 without any answer on a flow control topic after which "
        "its frames count as lost and the simulator goes on; 0: wait for ever.",
        0.0,
        3600.0,
    )
    action_timeout_s: float = _setting(
        0.5,
        "Wall time after the last action_command after which the driver takes over again.",
        0.0,
        3600.0,
        changeable=True,
    )
    start_time_s: float = _setting(
        1.0, "Stamp of frame 0 in simulated time; frame k has start_time_s + k period_s.", 0.001, 2e9
    )
    use_wall_stamps: bool = _setting(False, "Stamp every frame with the wall clock instead of simulated time.")
    publish_clock: bool = _setting(False, "Publish /clock with the stamp of every frame; not with use_wall_stamps.")
    record: str = _setting(
        "",
        "Recording of everything that is published: a new .mcap file, or a new folder for the layout of rosbag2; "
        "empty: none.",
    )
    ground_truth_frame: str = _setting(
        "maze", "Frame of the ground truth: origin at the maze's corner, x along columns."
    )
    base_frame: str = _setting("base_link", "Frame that moves: child of the ground truth, frame of actions and scan.")
    camera_frame: str = _setting("base_link", "Frame of the image, and of camera_info where there is one.")

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            _check(item.name, getattr(self, item.name), item.default, item.metadata)
        if self.publish_clock and self.use_wall_stamps:
            raise ValueError(
                "publish_clock is True; allowed: False together with use_wall_stamps, which has no simulated time"
            )

    def stamp_ns(self, frame: int, period_s: float) -> int:
        """Simulated time of a frame, computed from its number so that rounding never adds up."""
        return round(self.start_time_s * 1e9) + round(frame * period_s * 1e9)


def _check(name: str, value: Any, default: Any, metadata: Any) -> None:
    allowed = allowed_values(default, metadata)
    low, high, choices = metadata["low"], metadata["high"], metadata["choices"]
    if isinstance(default, tuple):
        good = isinstance(value, tuple) and all(isinstance(item, str) and item for item in value)
    elif isinstance(default, str):
        good = isinstance(value, str) and (value in choices if choices else value != "" or default == "")
    elif isinstance(default, bool):
        good = isinstance(value, bool)
    else:
        types = (int, float) if isinstance(default, float) else (int,)
        good = isinstance(value, types) and not isinstance(value, bool) and low <= value <= high
    if not good:
        raise ValueError(f"{name} is {value!r}; allowed: {allowed}")


def allowed_values(default: Any, metadata: Any) -> str:
    """What a field of this default and metadata may be, in words."""
    if isinstance(default, tuple):
        return "a list of topic names"
    if isinstance(default, str):
        if metadata["choices"]:
            return "one of " + ", ".join(metadata["choices"])
        return "a text" if default == "" else "a name that is not empty"
    if isinstance(default, bool):
        return "true or false"
    kind = "a number" if isinstance(default, float) else "a whole number"
    return f"{kind} from {metadata['low']:.15g} to {metadata['high']:.15g}"


def field_descriptions(config_type: type) -> dict[str, str]:
    """What each field of a config means: its metadata, its line in the docstring, or its comment in the source.

    A field that is described nowhere raises a ValueError: a parameter without a description is a mistake.
    """
    source, doc = inspect.getsource(config_type), inspect.getdoc(config_type) or ""
    described = {}
    for item in dataclasses.fields(config_type):
        text = item.metadata.get("description")
        if text is None:
            match = re.search(rf"^( *){item.name}: (.+(?:\n\1 +\S.*)*)", doc, re.MULTILINE)
            match = match or re.search(rf"^( +){item.name}: .*?  # (.+)$", source, re.MULTILINE)
            if match is None:
                raise ValueError(
                    f"{config_type.__name__}.{item.name} is described nowhere; expected a line "
                    f"`{item.name}: ...` in the docstring or a comment behind the field"
                )
            text = " ".join(match.group(2).split())
        text = _LIMITS.sub("", text)
        described[item.name] = text[0].upper() + text[1:].rstrip(".") + "."
    return described


def field_limits(config_type: type) -> dict[str, str]:
    """What the fields of a config may be, in words: from their metadata, or in brackets behind their comments."""
    source, limits = inspect.getsource(config_type), {}
    for item in dataclasses.fields(config_type):
        match = re.search(rf"^( +){item.name}: .*?  # .+$", source, re.MULTILINE)
        if item.metadata:
            limits[item.name] = allowed_values(item.default, item.metadata)
        elif match and (found := _LIMITS.search(match.group())):
            limits[item.name] = found.group(1)
    return limits
