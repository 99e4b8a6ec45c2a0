"""Give the nodes and readers what nobody expects, for minutes, and count what came of it.

    python -m tests.fuzz --files 10000 --messages 100000 --services 2000
    python -m tests.fuzz --only "TUM files" --files 100000 --seed 7

Each target runs in a process of its own, so that memory is its own and a crash is seen. The exit code is 1 where an
input ended in a traceback, a hang or a crash.
"""

import json
import os
import random
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

KINDS = ("taken", "clean line", "traceback", "hang", "slowest s", "memory MB")
SERVICES = "services of ngo_node"


@dataclass(frozen=True)
class Arguments:
    """How much to try."""

    files: int = 1000  # Mutants of files, shared by the kinds of files.
    messages: int = 5000  # Messages, shared by the nodes.
    services: int = 500  # Calls of services.
    seed: int = 0  # Seed of everything random.
    only: str = ""  # One target alone, by its name.


def one(name: str, count: int, seed: int) -> dict[str, float]:
    """Run one target in this process; prints an example of each fault."""
    import torch

    from tests.fuzz import files, nodes

    torch.set_num_threads(1)
    rng = random.Random(f"{seed} {name}")
    if name in files.TARGETS:
        with tempfile.TemporaryDirectory() as folder:
            outcomes = files.run(name, count, rng, Path(folder))
    else:
        outcomes = nodes.run_services(count, rng) if name == SERVICES else nodes.run_messages(name, count, rng)
    for line, example in outcomes.faults.items():
        print(f"{line}\n{example}", file=sys.stderr)
    return outcomes.numbers()


def main(arguments: Arguments) -> int:
    """Run all targets and print the table; returns the exit code."""
    from tests.fuzz.files import TARGETS
    from tests.fuzz.nodes import NODES

    counts = {
        **dict.fromkeys(TARGETS, arguments.files // len(TARGETS)),
        **dict.fromkeys(NODES, arguments.messages // len(NODES)),
        SERVICES: arguments.services,
    }
    table, bad = Table("target", "inputs", *KINDS), 0
    for name, count in counts.items():
        if count == 0 or arguments.only not in ("", name):
            continue
        command = [sys.executable, "-m", "tests.fuzz", "one", name, str(count), str(arguments.seed)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        if done.returncode:
            table.add_row(name, str(count), f"ended with code {done.returncode}")
            bad += 1
            continue
        numbers = json.loads(done.stdout.splitlines()[-1])
        bad += int(numbers["traceback"] + numbers["hang"])
        table.add_row(
            name,
            str(count),
            *(f"{numbers[kind]:.4g}" if kind == "slowest s" else f"{numbers[kind]:.0f}" for kind in KINDS),
        )
        print(f"{name}: {numbers}", file=sys.stderr, flush=True)
    Console(width=120).print(table)
    return int(bad > 0)


if __name__ == "__main__":
    if sys.argv[1:2] == ["one"]:
        print(json.dumps(one(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))))
    else:
        sys.exit(main(tyro.cli(Arguments, prog="tests.fuzz", description=__doc__)))
