"""Command line of the stand-in: gives way to a real `ros2`, else runs one of the few commands it serves."""

import argparse
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

SERVED = "run, topic list|echo|hz, node list, param list|get|set, service list|call, lifecycle get|set"
VERBS = {
    "topic": ("list", "echo", "hz"),
    "node": ("list",),
    "param": ("list", "get", "set"),
    "service": ("list", "call"),
    "lifecycle": ("get", "set"),
}
DESCRIPTION = f"""\
This is not the real `ros2` command but a stand-in for it: the ROS 2 wheels come without one.
It serves exactly: {SERVED}. They print the same as the real command.
Where a real `ros2` is on PATH, that one is run instead."""
NOT_SERVED = f"the stand-in for ros2 serves only: {SERVED}; install ROS 2 for the others"


class CommandError(Exception):
    """An error with one line for the user; the command ends with exit code 1."""


def real_ros2(search_path: str) -> Path | None:
    """The first `ros2` on a PATH that is a real one, not this stand-in nor another checkout's."""
    for folder in search_path.split(os.pathsep):
        candidate = Path(folder or ".") / "ros2"
        if not (candidate.is_file() and os.access(candidate, os.X_OK)):
            continue
        if not (candidate.resolve().parent / Path(__file__).parent.name).is_dir():
            return candidate
    return None


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands; each sub-parser has its words in ``command`` and ``verb``."""
    parser = argparse.ArgumentParser(
        "ros2", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    run = commands.add_parser("run", help="run an executable of a package")
    run.add_argument("--prefix", default="", help="command in front of the executable, e.g. 'nice -n 5'")
    run.add_argument("package_name", help="name of the package")
    run.add_argument("executable_name", help="name of the executable")
    run.add_argument("argv", nargs=argparse.REMAINDER, help="arguments of the executable")
    of = {name: commands.add_parser(name).add_subparsers(dest="verb", required=True) for name in VERBS}
    verb = of["topic"].add_parser("list", help="output a list of available topics")
    verb.add_argument("-t", "--show-types", action="store_true", help="additionally show the topic type")
    verb = of["topic"].add_parser("echo", help="output messages from a topic")
    verb.add_argument("topic_name", help="name of the topic to listen to, e.g. /ngo/path")
    verb.add_argument("message_type", nargs="?", help="type of the message, e.g. nav_msgs/msg/Path")
    verb.add_argument("--once", action="store_true", help="print the first message received and then exit")
    verb.add_argument("--field", help="echo a selected field of a message; '.' selects sub-fields")
    verb.add_argument("-f", "--full-length", action="store_true", help="output all elements of arrays and strings")
    verb = of["topic"].add_parser("hz", help="print the average receiving rate to screen")
    verb.add_argument("topic_name", help="name of the topic to listen to, e.g. /odom")
    verb.add_argument("-w", "--window", type=int, default=10000, help="messages that the rate is calculated from")
    verb = of["node"].add_parser("list", help="output a list of available nodes")
    verb.add_argument("-a", "--all", action="store_true", help="display all nodes even hidden ones")
    verb = of["param"].add_parser("list", help="output a list of available parameters")
    verb.add_argument("node_name", nargs="?", help="name of the node")
    verb = of["param"].add_parser("get", help="get a parameter")
    verb.add_argument("node_name", help="name of the node")
    verb.add_argument("parameter_name", help="name of the parameter")
    verb.add_argument("--hide-type", action="store_true", help="hide the type information")
    verb = of["param"].add_parser("set", help="set a parameter")
    verb.add_argument("node_name", help="name of the node")
    verb.add_argument("parameter_name", help="name of the parameter")
    verb.add_argument("value", help="its new value, in YAML")
    of["service"].add_parser("list", help="output a list of available services")
    verb = of["service"].add_parser("call", help="call a service")
    verb.add_argument("service_name", help="name of the service, e.g. /ngo_node/pause")
    verb.add_argument("service_type", help="type of the service, e.g. std_srvs/srv/SetBool")
    verb.add_argument("values", nargs="?", default="{}", help="values of the request, in YAML")
    verb = of["lifecycle"].add_parser("get", help="get the state of a node")
    verb.add_argument("node_name", help="name of the node")
    verb = of["lifecycle"].add_parser("set", help="trigger a transition")
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


def executable_path(package: str, executable: str) -> Path:
    """The executable of that name below the lib folder of a package in the ament index."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix and Path(prefix, "share/ament_index/resource_index/packages", package).is_file():
            path = Path(prefix, "lib", package, executable)
            if path.is_file() and os.access(path, os.X_OK):
                return path
            raise CommandError("No executable found")
    raise CommandError(f"Package '{package}' not found")


def dispatch(options: argparse.Namespace) -> int:
    """Run the command, and return its exit code."""
    if options.command == "run":  # the executable gets the signals, and its exit code is the command's
        path = executable_path(options.package_name, options.executable_name)
        command = [*shlex.split(options.prefix), str(path), *options.argv]
        os.execvp(command[0], command)
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise CommandError(f"rclpy cannot be imported ({error}); open the environment first: . ./env.sh") from None
    from ros2_stand_in import services, topics

    o = options
    commands: dict[tuple[str, str], Callable[[], int]] = {
        ("topic", "list"): lambda: topics.print_list("topic", o.show_types),
        ("topic", "echo"): lambda: topics.echo(o.topic_name, o.message_type, o.once, o.field, o.full_length),
        ("topic", "hz"): lambda: topics.hz(o.topic_name, o.window),
        ("node", "list"): lambda: topics.print_list("node", include_hidden=o.all),
        ("param", "list"): lambda: services.print_parameters(o.node_name),
        ("param", "get"): lambda: services.print_parameter(o.node_name, o.parameter_name, o.hide_type),
        ("param", "set"): lambda: services.set_parameter(o.node_name, o.parameter_name, o.value),
        ("service", "list"): lambda: topics.print_list("service"),
        ("service", "call"): lambda: services.call_service(o.service_name, o.service_type, o.values),
        ("lifecycle", "get"): lambda: services.print_state(o.node_name),
        ("lifecycle", "set"): lambda: services.change_state(o.node_name, o.transition),
    }
    return commands[o.command, o.verb]()


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
        return dispatch(make_parser().parse_args(arguments))
    except CommandError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return int(signal.SIGINT)  # the real command's exit code
    except BrokenPipeError:
        # The reader has gone (`ros2 topic list | head -1`): Python must not try to flush into the pipe at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
