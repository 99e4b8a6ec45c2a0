"""The estimator nodes' parameters: what is allowed, and the files that list them."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest
import yaml

from ngo_estimator.nodes.parameters import BadParameter, Settings, frame, setting, topic
from ngo_estimator.nodes.settings import LocalNodeSettings, NgoNodeSettings

CONFIG = Path(__file__).parents[3] / "ros_ws/src/ngo_estimator/config"
KINDS = {"local_node": LocalNodeSettings, "ngo_node": NgoNodeSettings}


@dataclass(frozen=True)
class Example(Settings):
    count: int = setting(3, "A count.", minimum=1, maximum=5)
    share: float = setting(0.5, "A share.", minimum=0.0, maximum=1.0)
    mode: str = setting("slow", "A mode.", choices=("slow", "fast"))
    switch: bool = setting(True, "A switch.")
    stream: str = topic("image", "A topic.")
    place: str = frame("map", "A frame.")


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("count", 0, "an integer from 1 to 5"),
        ("count", 6, "an integer from 1 to 5"),
        ("count", 2.0, "an integer from 1 to 5"),
        ("count", True, "an integer from 1 to 5"),
        ("count", None, "an integer from 1 to 5"),
        ("share", float("nan"), "a number from 0 to 1"),
        ("share", float("inf"), "a number from 0 to 1"),
        ("share", "half", "a number from 0 to 1"),
        ("mode", "medium", "slow or fast"),
        ("switch", 1, "true or false"),
        ("switch", "yes", "true or false"),
        ("stream", "two words", "a topic name, as in image or /robot/image"),
        ("stream", "", "a topic name, as in image or /robot/image"),
        ("place", "/map", "a frame name without / in front"),
        ("place", "", "a frame name without / in front"),
    ],
)
def test_a_bad_value_is_named_with_what_is_allowed(name: str, value: Any, allowed: str) -> None:
    with pytest.raises(BadParameter) as error:
        Example(**{name: value})
    assert str(error.value) == f"parameter '{name}' is {value!r}; allowed: {allowed}"


def test_the_limits_themselves_are_allowed() -> None:
    Example(count=1, share=0.0, mode="fast", switch=False, stream="/robot_1/image", place="robot_1/map")
    Example(count=5, share=1.0)


@pytest.mark.parametrize("name", KINDS)
def test_the_file_lists_every_parameter_with_its_default(name: str) -> None:
    listed = yaml.safe_load((CONFIG / f"{name}.yaml").read_text())[name]["ros__parameters"]
    assert listed == {entry.name: entry.default for entry in fields(KINDS[name])}


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.name)
def test_every_file_is_accepted(path: Path) -> None:
    for name, content in yaml.safe_load(path.read_text()).items():
        if name in KINDS:
            KINDS[name](**content["ros__parameters"])


def test_frames_that_would_coincide_and_a_short_queue_are_errors() -> None:
    with pytest.raises(BadParameter, match="another name than odom_frame's"):
        LocalNodeSettings(base_frame="odom")
    with pytest.raises(BadParameter, match="another name than odom_frame's"):
        NgoNodeSettings(map_frame="odom")
    with pytest.raises(BadParameter, match="at least window_frames, which is 3000"):
        NgoNodeSettings(window_frames=3000)
