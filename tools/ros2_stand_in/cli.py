"""Command line of the stand-in: gives way to a real `ros2`, else parses and runs one of the few commands it serves."""

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from ros2_stand_in.errors import CommandError

SERVED = "run, topic list|echo|hz, node list, param list|get|set, service list|call, lifecycle get|set"
DESCRIPTION = f"""\
This is not the real `ros2` command but a stand-in for it: the ROS 2 wheels come without one.
It serves exactly: {SERVED}. They print the same as the real command.
Where a real `ros2` is on PATH, that one is run instead."""
NOT_SERVED = f"the stand-in for ros2 serves only: {SERVED}; install ROS 2 for the others"

VERBS = {
    "topic": ("list", "echo", "hz"),
    "node": ("list",),
    "param": ("list", "get", "set"),
    "service": ("list", "call"),
    "lifecycle": ("get", "set"),
}
DEFAULT_TRUNCATE_LENGTH = 128
DEFAULT_WINDOW = 10000


def real_ros2(search_path: str) -> Path | None:
    """The first `ros2` on a PATH that is a real one, not this stand-in nor another checkout's."""
    for folder in search_path.split(os.pathsep):
        candidate = Path(folder or ".") / "ros2"
        if not (candidate.is_file() and os.access(candidate, os.X_OK)):
            continue
        if not (candidate.resolve().parent / Path(__file__).parent.name).is_dir():
            return candidate
    return None


def non_negative(text: str) -> int:
    """An argument that is a whole number from 0."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError("value must be non-negative integer")
    return int(text)


def positive(text: str) -> int:
    """An argument that is a whole number from 1."""
    if not text.isdigit() or int(text) == 0:
        raise argparse.ArgumentTypeError("value must be a positive integer")
    return int(text)


def make_parser() -> argparse.ArgumentParser:
    """The parser of everything but `run`, whose arguments belong to the executable."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("ros2", description=DESCRIPTION, formatter_class=raw)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    commands.add_parser("run", help="run an executable of a package", add_help=False)

    topic = commands.add_parser("topic", help="list, echo or time topics")
    verbs = topic.add_subparsers(dest="verb", metavar="VERB", required=True)
    verb = verbs.add_parser("list", help="output a list of available topics")
    verb.add_argument("-t", "--show-types", action="store_true", help="additionally show the topic type")
    verb = verbs.add_parser("echo", help="output messages from a topic")
    verb.add_argument("topic_name", help="name of the topic to listen to, e.g. /ngo/path")
    verb.add_argument("message_type", nargs="?", help="type of the message, e.g. nav_msgs/msg/Path")
    verb.add_argument("--once", action="store_true", help="print the first message received and then exit")
    verb.add_argument("--field", help="echo a selected field of a message; '.' selects sub-fields")
    verb.add_argument("-f", "--full-length", action="store_true", help="output all elements of arrays and strings")
    verb.add_argument(
        "-l", "--truncate-length", type=non_negative, default=DEFAULT_TRUNCATE_LENGTH, metavar="N",
        help=f"the length to truncate arrays and strings to (default: {DEFAULT_TRUNCATE_LENGTH})",
    )  # fmt: skip
    verb = verbs.add_parser("hz", help="print the average receiving rate to screen")
    verb.add_argument("topic_name", help="name of the topic to listen to, e.g. /odom")
    verb.add_argument(
        "-w", "--window", type=positive, default=DEFAULT_WINDOW, metavar="N",
        help=f"number of messages that the rate is calculated from (default: {DEFAULT_WINDOW})",
    )  # fmt: skip

    node = commands.add_parser("node", help="list nodes")
    verbs = node.add_subparsers(dest="verb", metavar="VERB", required=True)
    verb = verbs.add_parser("list", help="output a list of available nodes")
    verb.add_argument("-a", "--all", action="store_true", help="display all nodes even hidden ones")

    param = commands.add_parser("param", help="list, get or set parameters")
    verbs = param.add_subparsers(dest="verb", metavar="VERB", required=True)
    verb = verbs.add_parser("list", help="output a list of available parameters")
    verb.add_argument("node_name", nargs="?", help="name of the node")
    verb = verbs.add_parser("get", help="get a parameter")
    verb.add_argument("node_name", help="name of the node")
    verb.add_argument("parameter_name", help="name of the parameter")
    verb.add_argument("--hide-type", action="store_true", help="hide the type information")
    verb = verbs.add_parser("set", help="set a parameter")
    verb.add_argument("node_name", help="name of the node")
    verb.add_argument("parameter_name", help="name of the parameter")
    verb.add_argument("value", help="its new value, in YAML")

    service = commands.add_parser("service", help="list or call services")
    verbs = service.add_subparsers(dest="verb", metavar="VERB", required=True)
    verbs.add_parser("list", help="output a list of available services")
    verb = verbs.add_parser("call", help="call a service")
    verb.add_argument("service_name", help="name of the service, e.g. /ngo_node/pause")
    verb.add_argument("service_type", help="type of the service, e.g. std_srvs/srv/SetBool")
    verb.add_argument("values", nargs="?", default="{}", help="values of the request, in YAML")

    lifecycle = commands.add_parser("lifecycle", help="get or change the state of managed nodes")
    verbs = lifecycle.add_subparsers(dest="verb", metavar="VERB", required=True)
    verb = verbs.add_parser("get", help="get the state of a node")
    verb.add_argument("node_name", help="name of the node")
    verb = verbs.add_parser("set", help="trigger a transition")
    verb.add_argument("node_name", help="name of the node")
    verb.add_argument("transition", help="label or number of the transition, e.g. configure")
    return parser


def unserved(arguments: Sequence[str]) -> str | None:
    """One line about a command or verb that is not served, or None."""
    words = [argument for argument in arguments[:2] if not argument.startswith("-")]
    if words and words[0] not in ("run", *VERBS):
        return f"ros2 {words[0]}: {NOT_SERVED}"
    if len(words) == 2 and words[0] in VERBS and words[1] not in VERBS[words[0]]:
        return f"ros2 {words[0]} {words[1]}: {NOT_SERVED}"
    return None


def dispatch(arguments: Sequence[str]) -> int:
    """Run the command, and return its exit code."""
    if arguments[:1] == ["run"]:
        from ros2_stand_in import executables

        return executables.run(arguments[1:])
    options = make_parser().parse_args(arguments)
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise CommandError(f"rclpy cannot be imported ({error}); open the environment first: . ./env.sh") from None
    from ros2_stand_in import graph, parameters, services, topics

    if options.command == "service":
        if options.verb == "list":
            return services.print_services()
        return services.call_service(options.service_name, options.service_type, options.values)
    if options.command == "lifecycle":
        if options.verb == "get":
            return services.print_state(options.node_name)
        return services.change_state(options.node_name, options.transition)
    if options.command == "node":
        return graph.print_nodes(include_hidden=options.all)
    if options.command == "param":
        if options.verb == "list":
            return parameters.print_list(options.node_name)
        if options.verb == "get":
            return parameters.print_value(options.node_name, options.parameter_name, options.hide_type)
        return parameters.set_value(options.node_name, options.parameter_name, options.value)
    if options.verb == "list":
        return topics.print_list(show_types=options.show_types)
    if options.verb == "hz":
        return topics.hz(options.topic_name, options.window)
    length = None if options.full_length else options.truncate_length
    return topics.echo(options.topic_name, options.message_type, options.once, options.field, length)


def main(arguments: Sequence[str]) -> int:
    """Entry point: returns the exit code."""
    real = real_ros2(os.environ.get("PATH", ""))
    if real is not None:
        os.execv(real, [str(real), *arguments])
    line = unserved(arguments)
    if line is not None:
        print(line, file=sys.stderr)
        return 2
    if not arguments:
        make_parser().print_help()
        return 0
    try:
        return dispatch(list(arguments))
    except CommandError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return int(signal.SIGINT)  # the real command's exit code
    except BrokenPipeError:
        # The reader has gone (`ros2 topic list | head -1`): Python must not try to flush into the pipe at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
