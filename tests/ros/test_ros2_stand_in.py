"""The stand-in for `ros2` against a real node in its own process; expected is what the real command prints."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovariance
from ngo_msgs.msg import RelativePose
from rclpy.parameter import Parameter
from std_msgs.msg import Header

from .processes import run_forked

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

from ros2_stand_in import cli  # noqa: E402
from ros2_stand_in.cli import CommandError  # noqa: E402
from ros2_stand_in.graph import interface  # noqa: E402
from ros2_stand_in.services import call_service, parse_value, value_text  # noqa: E402
from ros2_stand_in.topics import RateWindow, echo_text  # noqa: E402

ROS2 = TOOLS / "ros2"
TIMEOUT_S = 60.0


def environment() -> dict[str, str]:
    """An environment with no folder on PATH that holds a real `ros2`, and without transport over shared memory.

    What a killed process leaves in shared memory makes Fast DDS write to the standard output, which is compared here.
    """
    folders = os.environ["PATH"].split(os.pathsep)
    path = os.pathsep.join(folder for folder in folders if cli.real_ros2(folder) is None)
    return {**os.environ, "PATH": path, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}


def ros2(*arguments: str, **changes: str) -> subprocess.CompletedProcess[str]:
    return run_forked([str(ROS2), *arguments], TIMEOUT_S, {**environment(), **changes})


def listed(*arguments: str, expected: list[str]) -> list[str]:
    """The lines that a command prints, tried again while they differ: discovery takes long on a busy machine."""
    deadline = time.monotonic() + TIMEOUT_S
    while (lines := ros2(*arguments).stdout.splitlines()) != expected and time.monotonic() < deadline:
        pass
    return lines


@pytest.fixture(scope="module")
def talker() -> Iterator[None]:
    process = subprocess.Popen([sys.executable, str(Path(__file__).with_name("talker.py"))], env=environment())
    try:
        assert listed("node", "list", expected=["/test/talker"]) == ["/test/talker"]
        yield
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT_S) == 0


# What it is, and what it leaves to the real one


def test_help_says_that_it_is_a_stand_in_and_what_it_serves() -> None:
    text = subprocess.run([ROS2, "--help"], capture_output=True, text=True, env=environment()).stdout
    assert "not the real `ros2` command but a stand-in" in text
    assert cli.SERVED in text


def test_another_command_gives_one_line_that_names_the_served_ones() -> None:
    result = ros2("bag", "record")
    assert (result.returncode, result.stdout, len(result.stderr.splitlines())) == (2, "", 1)
    for arguments in (["bag", "record"], ["launch"], ["topic", "info", "/x"], ["param", "dump", "/n"]):
        assert cli.SERVED in str(cli.unserved(arguments))


def test_a_real_ros2_on_path_is_run_instead(tmp_path: Path) -> None:
    real = tmp_path / "ros2"
    real.write_text('#!/bin/sh\necho "real: $*"\nexit 5\n')
    real.chmod(0o755)
    result = ros2("topic", "list", "--anything", PATH=f"{TOOLS}:{tmp_path}:{os.environ['PATH']}")
    assert (result.returncode, result.stdout) == (5, "real: topic list --anything\n")


# run


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """An install prefix with one package `tool`, whose executable prints its arguments and ends with code 3."""
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "tool").touch()
    executable = tmp_path / "lib/tool/print"
    executable.parent.mkdir(parents=True)
    executable.write_text('#!/bin/sh\nfor a in "$@"; do echo "<$a>"; done\nexit 3\n')
    executable.chmod(0o755)
    (executable.parent / "data").touch()
    return tmp_path


def test_run_passes_arguments_and_exit_code_through(prefix: Path) -> None:
    arguments = ["--ros-args", "-p", "name:=a b", "-r", "__ns:=/x", "--", "--help"]
    result = ros2("run", "tool", "print", *arguments, AMENT_PREFIX_PATH=str(prefix))
    assert result.returncode == 3
    assert result.stdout.splitlines() == [f"<{argument}>" for argument in arguments]


@pytest.mark.parametrize(
    ("package", "executable", "line"),
    [
        ("tool", "data", "No executable found"),
        ("tool", "nothing", "No executable found"),
        ("nothing", "print", "Package 'nothing' not found"),
    ],
)
def test_run_says_what_is_not_there(prefix: Path, package: str, executable: str, line: str) -> None:
    result = ros2("run", package, executable, AMENT_PREFIX_PATH=str(prefix))
    assert (result.returncode, result.stderr) == (1, f"{line}\n")


# Messages as text


def test_a_message_is_printed_as_yaml_in_block_style() -> None:
    header = Header(stamp=Time(sec=1, nanosec=2), frame_id="odom")
    assert echo_text(header) == "stamp:\n  sec: 1\n  nanosec: 2\nframe_id: odom\n---"
    assert echo_text(Header()).splitlines()[-2] == "frame_id: ''"
    assert echo_text(Header(frame_id="größe")).splitlines()[-2] == "frame_id: größe"


def test_arrays_of_every_kind_are_lists_and_end_with_dots_past_the_limit() -> None:
    message = RelativePose(
        covariance=np.arange(9.0), motion_feature=[0.5, 1.5], place_code=np.ones(200, dtype=np.float32).tolist()
    )
    text = echo_text(message, truncate_length=128)
    assert "covariance:\n- 0.0\n- 1.0\n" in text
    assert "motion_feature:\n- 0.5\n- 1.5\n" in text
    assert "- 1.0\n- '...'\nunlikeness: 0.0\nfrom_place_code: []\n" in text
    assert text.count("\n- 1.0") == 128 + 1
    assert echo_text(message).count("\n- 1.0") == 200 + 1
    empty = echo_text(RelativePose())
    assert "motion_feature: []\nplace_code: []\nunlikeness: 0.0\nfrom_place_code: []\n" in empty


def test_a_field_is_a_message_a_number_or_an_array() -> None:
    message = PoseWithCovariance()
    message.pose.position.x = 2.5
    assert echo_text(message, "pose.position") == "x: 2.5\ny: 0.0\nz: 0.0\n---"
    assert echo_text(message, "pose.position.x") == "2.5\n---"
    with pytest.raises(CommandError, match=r"Invalid field 'pose\.speed'"):
        echo_text(message, "pose.speed")


@pytest.mark.parametrize("name", ["Header", "std_msgs/Header", "std_msgs/msg/Nothing", "nothing/msg/Header", "//"])
def test_a_wrong_type_name_is_refused(name: str) -> None:
    with pytest.raises(CommandError, match="invalid"):
        interface(name, "msg")


# Rates


def test_the_rate_is_the_real_commands_report() -> None:
    rate = RateWindow(window=10_000)
    reports = []
    for index in range(0, 25):
        rate.add(1_000_000_000 + index * 100_000_000)
        reports.append(rate.report())
    # The first interval only starts the clock; a report follows each second after it.
    assert [index for index, report in enumerate(reports) if report] == [11, 21]
    assert reports[11] == "average rate: 10.000\n\tmin: 0.100s max: 0.100s std dev: 0.00000s window: 11"


# Parameter values


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("5", "integer_value", 5),
        ("-5", "integer_value", -5),
        ("5.0", "double_value", 5.0),
        ("true", "bool_value", True),
        ("word", "string_value", "word"),
        ("[1, 2]", "integer_array_value", [1, 2]),
        ("['a', b]", "string_array_value", ["a", "b"]),
        ("{a: 1}", "string_value", "{a: 1}"),
        ("a: b: c", "string_value", "a: b: c"),
        ("[1", "string_value", "[1"),
    ],
)
def test_a_value_has_the_type_that_yaml_takes_it_for(text: str, field: str, value: object) -> None:
    parsed = getattr(parse_value(text), field)
    assert (list(parsed) if isinstance(value, list) else parsed) == value


@pytest.mark.parametrize(
    ("value", "line"),
    [
        (7, "Integer value is: 7"),
        (0.5, "Double value is: 0.5"),
        ("base_link", "String value is: base_link"),
        (True, "Boolean value is: True"),
        ([1, 2, 3], "Integer values are: array('q', [1, 2, 3])"),
        (["a", "b"], "String values are: ['a', 'b']"),
    ],
)
def test_a_value_is_printed_with_its_type(value: object, line: str) -> None:
    message = Parameter("name", value=value).get_parameter_value()
    assert value_text(message) == line
    assert value_text(message, hide_type=True) == line.partition(": ")[2]


# Requests


@pytest.mark.parametrize(
    ("kind", "values", "line"),
    [
        ("std_srvs/srv/SetBool", "{state: true}", "has no attribute 'state'"),
        ("lifecycle_msgs/srv/ChangeState", "{transition: {id: one}}", "Failed to populate field: invalid literal"),
        ("lifecycle_msgs/srv/ChangeState", "{transition: 1}", "expected a mapping of names to values, got 1"),
        ("std_srvs/srv/SetBool", "[1", "The values are no YAML"),
        ("std_srvs/srv/Nothing", "{}", "The passed service type is invalid"),
    ],
)
def test_a_request_that_is_none_is_one_line(kind: str, values: str, line: str) -> None:
    with pytest.raises(CommandError) as error:
        call_service("/test/mute", kind, values)
    assert line in str(error.value) and "\n" not in str(error.value)


# Against a real node


@pytest.mark.processes
@pytest.mark.usefixtures("talker")
class TestAgainstARealNode:
    def test_topic_list(self) -> None:
        """Without types as lists of nodes and services are made, too."""
        names = ["/parameter_events", "/rosout", "/test/header", "/test/image", "/test/path", "/test/status"]
        names.append("/test/talker/transition_event")
        types = ["rcl_interfaces/msg/ParameterEvent", "rcl_interfaces/msg/Log", "std_msgs/msg/Header"]
        types += ["sensor_msgs/msg/Image", "nav_msgs/msg/Path", "diagnostic_msgs/msg/DiagnosticStatus"]
        types.append("lifecycle_msgs/msg/TransitionEvent")
        typed = [f"{name} [{kind}]" for name, kind in zip(names, types, strict=True)]
        assert listed("topic", "list", "-t", expected=typed) == typed

    def test_echo_of_a_best_effort_topic(self) -> None:
        result = ros2("topic", "echo", "/test/header", "--once")
        assert result.returncode == 0, result.stderr
        assert re.fullmatch(r"stamp:\n  sec: 12\n  nanosec: \d+\nframe_id: odom\n---\n", result.stdout)

    def test_echo_of_a_message_published_before_it_came(self) -> None:
        lines = ros2("topic", "echo", "/test/image", "--once").stdout.splitlines()
        start = lines.index("data:")
        assert lines[start + 1 :] == [*(f"- {value}" for value in range(128)), "- '...'", "---"]
        whole = ros2("topic", "echo", "/test/image", "--once", "--full-length").stdout.splitlines()
        assert whole[start + 1 :] == [*(f"- {value}" for value in range(200)), "---"]

    def test_echo_of_bytes_and_long_strings(self) -> None:
        lines = ros2("topic", "echo", "/test/status", "--once").stdout.splitlines()
        message = f"message: {'x' * 128}..."
        assert lines == ['level: "\\x01"', "name: größe", message, "hardware_id: ''", "values: []", "---"]

    def test_hz(self) -> None:
        command = [sys.executable, str(ROS2), "topic", "hz", "/test/header"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())
        assert process.stdout is not None
        first = process.stdout.readline()
        if first.startswith("WARNING: topic"):  # discovery took long on a busy machine
            first = process.stdout.readline()
        text = first + process.stdout.readline()
        process.terminate()
        assert process.wait(TIMEOUT_S) == 0
        process.stdout.close()
        numbers = r"min: (\d+\.\d{3})s max: (\d+\.\d{3})s std dev: \d+\.\d{5}s window: (\d+)"
        found = re.fullmatch(rf"average rate: (\d+\.\d{{3}})\n\t{numbers}\n", text)
        assert found, text
        # A busy machine keeps the talker from its rate, but the report is of one second or more of what came.
        rate, shortest_s, longest_s, window = map(float, found.groups())
        # Times are printed in whole milliseconds: a period may be half a millisecond longer or shorter.
        assert shortest_s - 0.001 < 1.0 / rate < longest_s + 0.001
        assert window / rate > 0.99 and rate < 30.0

    def test_param_list(self) -> None:
        own = ["enabled", "frame", "gain", "names", "speed", "steps"]
        lines = ros2("param", "list", "/test/talker").stdout.splitlines()
        assert set(own) <= {line.removeprefix("  ") for line in lines}
        assert lines == sorted(lines)
        every = ["/test/talker:", *lines]
        assert listed("param", "list", expected=every) == every

    def test_param_get(self) -> None:
        line = "Integer value is: 7"
        assert listed("param", "get", "/test/talker", "speed", expected=[line]) == [line]
        arguments = "param", "get", "test/talker", "frame", "--hide-type"
        assert listed(*arguments, expected=["base_link"]) == ["base_link"]

    def test_param_set(self) -> None:
        said = ["Set parameter successful"]
        assert listed("param", "set", "/test/talker", "gain", "0.25", expected=said) == said
        assert listed("param", "get", "/test/talker", "gain", expected=["Double value is: 0.25"])[0].endswith("0.25")

    def test_service_list(self) -> None:
        wanted = {"/test/mute", "/test/talker/change_state", "/test/talker/get_parameters"}
        deadline = time.monotonic() + TIMEOUT_S
        while not wanted <= set(lines := ros2("service", "list").stdout.splitlines()):
            assert time.monotonic() < deadline, lines
        assert lines == sorted(lines)

    def test_service_call(self) -> None:
        result = ros2("service", "call", "/test/mute", "std_srvs/srv/SetBool", "{data: true}")
        assert result.returncode == 0, result.stderr
        assert result.stdout.removeprefix("waiting for service to become available...\n") == (
            "requester: making request: std_srvs.srv.SetBool_Request(data=True)\n\n"
            "response:\nstd_srvs.srv.SetBool_Response(success=True, message='as you wish')\n\n"
        )

    def test_lifecycle(self) -> None:
        assert listed("lifecycle", "get", "/test/talker", expected=["unconfigured [1]"]) == ["unconfigured [1]"]
        refused = ros2("lifecycle", "set", "/test/talker", "activate")
        assert refused.returncode == 1
        assert refused.stderr.startswith("Unknown transition requested, available ones are:\n- configure [1]\n")
        assert ros2("lifecycle", "set", "/test/talker", "configure").stdout == "Transitioning successful\n"
        assert listed("lifecycle", "get", "test/talker", expected=["inactive [2]"]) == ["inactive [2]"]

    def test_a_node_topic_or_parameter_that_is_not_there(self) -> None:
        result = ros2("param", "get", "/test/nobody", "speed")
        assert (result.returncode, result.stderr) == (1, "Node not found\n")
        result = ros2("param", "get", "/test/talker", "nothing")
        assert (result.returncode, result.stderr) == (1, "Parameter not set\n")
        result = ros2("topic", "echo", "/test/nothing")
        assert result.stdout == "WARNING: topic [/test/nothing] does not appear to be published yet\n"
        assert (result.returncode, result.stderr) == (
            1,
            "Could not determine the type for the passed topic: if its node is starting, wait for its line 'ready'\n",
        )
