"""Settings: their checks, the values that users give, and the text of --help."""

from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from ngo_common.settings import (
    BadParameter,
    FramedSettings,
    frame,
    make_settings,
    optional_frame,
    pose,
    refuse_unknown,
    setting,
    topic,
    topics,
    usage,
)


@dataclass(frozen=True)
class Example(FramedSettings):
    count: int = setting(3, "A count.", minimum=1, maximum=5)
    share: float = setting(0.5, "A share.", minimum=0.0, maximum=1.0)
    mode: str = setting("slow", "A mode.", choices=("slow", "fast"), alias="way")
    switch: bool = setting(True, "A switch.")
    stream: str = topic("image", "A topic.")
    streams: tuple[str, ...] = topics(("odom",), "Topics.")
    place: str = frame("map", "A frame.")
    above: str = optional_frame("", "Another frame.")
    start: tuple[float, float, float] = pose((0.0, 0.0, 0.0), "A pose.")
    pace: float = setting(1.0, "A pace.", minimum=0.0, maximum=9.0, live=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.count == 4 and self.mode == "slow":
            raise ValueError("count is 4; allowed: 1 to 3 together with slow")


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
        ("share", True, "a number from 0 to 1"),
        ("mode", "medium", "slow or fast"),
        ("switch", 1, "true or false"),
        ("switch", "yes", "true or false"),
        ("stream", "two words", "a topic name, as in image or /robot/image"),
        ("stream", "", "a topic name, as in image or /robot/image"),
        ("streams", ("odom", "a/"), "a list of topic names"),
        ("streams", "odom", "a list of topic names"),
        ("streams", (3,), "a list of topic names"),
        ("place", "/map", "a frame name without / in front"),
        ("place", "", "a frame name without / in front"),
        ("above", "/map", "a frame name without / in front, or nothing"),
        ("frame_prefix", "/red/", "a text that a frame name may begin with, as in robot_1/, or nothing"),
        ("start", (1.0, 2.0), "three numbers up to 1e+09: x (m), y (m), yaw (rad)"),
        ("start", (1.0, 2.0, float("nan")), "three numbers up to 1e+09: x (m), y (m), yaw (rad)"),
        ("start", (1.0, 2.0, 1e308), "three numbers up to 1e+09: x (m), y (m), yaw (rad)"),
        ("start", ("a", "b", "c"), "three numbers up to 1e+09: x (m), y (m), yaw (rad)"),
        ("start", 3.0, "three numbers up to 1e+09: x (m), y (m), yaw (rad)"),
    ],
)
def test_a_bad_value_is_named_with_what_is_allowed(name: str, value: Any, allowed: str) -> None:
    with pytest.raises(BadParameter) as error:
        Example(**{name: value})
    assert str(error.value) == f"parameter '{name}' is {value!r}; allowed: {allowed}"


def test_the_limits_themselves_are_allowed() -> None:
    Example(count=1, share=0.0, mode="fast", switch=False, stream="/robot_1/image", place="robot_1/map", streams=())
    Example(count=5, share=1)
    Example(count=np.int64(2), share=np.float32(0.25))


def test_frames_get_the_prefix() -> None:
    assert Example(frame_prefix="red/").framed("map") == "red/map"
    assert Example().framed("map") == "map"


def test_given_values_are_taken_in_the_type_of_their_field() -> None:
    given = {"share": 1, "start": array("d", [1.0, 2.0, 3.0]), "pace": 2, "streams": None}
    assert make_settings(Example, given) == Example(share=1.0, start=(1.0, 2.0, 3.0), pace=2.0, streams=())
    assert make_settings(Example, {"start": [1, 2, 3]}) == Example(start=(1.0, 2.0, 3.0))
    assert make_settings(Example, {"count": 1}, {"count": 2, "pace": 3.0}) == Example(count=1, pace=3.0)


def test_unknown_names_are_errors_with_a_hint() -> None:
    with pytest.raises(BadParameter, match="parameter 'speed' is 3, but unknown; allowed: above, count, frame_prefix"):
        make_settings(Example, {"speed": 3})
    with pytest.raises(BadParameter, match="parameter 'cuont' is 3, but unknown; did you mean count"):
        make_settings(Example, {"cuont": 3})
    refuse_unknown({"count": 1, "way": "fast"}, (Example,))


def test_a_second_name_is_taken_but_not_both() -> None:
    assert make_settings(Example, {"way": "fast"}) == Example(mode="fast")
    with pytest.raises(BadParameter, match="parameters 'way' and 'mode' are the same; allowed: one of them"):
        make_settings(Example, {"way": "fast", "mode": "slow"})


def test_a_condition_between_fields_is_a_bad_parameter() -> None:
    with pytest.raises(BadParameter, match="count is 4; allowed: 1 to 3 together with slow"):
        make_settings(Example, {"count": 4})


def test_the_help_lists_every_parameter() -> None:
    text = usage("ngo_x", "example", "Does things.", Example, count=2)
    lines = text.splitlines()
    assert lines[0].startswith("usage: ros2 run ngo_x example ")
    assert "Does things." in lines
    shown = [line.split(":=")[0].strip() for line in lines if ":=" in line and line.startswith("  ")]
    assert shown == sorted(Example.__dataclass_fields__)
    assert "  count:=2  (an integer from 1 to 5)" in lines
    assert "  switch:=true  (true or false)" in lines
    assert "  streams:=[odom]  (a list of topic names)" in lines
    assert "  pace:=1.0  (a number from 0 to 9; at any time)" in lines
    assert "      A mode. May be given as way." in lines
    assert "  above:=''  (a frame name without / in front, or nothing)" in lines
