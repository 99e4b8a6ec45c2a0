"""Train or fit one network: `TASK` says which.

    python -m training.train TASK ...
    python -m training.train local --world maze2d
    python -m training.train TASK --help

Each task is a module of its own, `training.train_TASK`: its data, loss, network, metric and schedule. What they share
is in `training.common`: `Run` has folder, seed, precision, checkpoints, curves and record, `Training` the optimiser.
`python -m training.train_TASK` does the same.
"""

import sys
from importlib import import_module

from training.common.command_line import run_command

TASKS = {
    "local": "the local pose network, on pairs of consecutive frames",
    "place": "the place encoder and its pair head, on pairs of frames of one place",
    "familiarity": "what recognises input that is unlike that of the training",
    "smoother": "the smoother of the odometry, or the memory of the local network",
    "optimizer": "the pose aggregation and the Neural Graph Optimizer",
    "end_to_end": "all networks of a world together",
    "ranges": "the ranges that Doom's place encoder sees in pictures",
    "loop_judge": "the judge of Doom's loops",
    "deepvo": "DeepVO, the baseline",
    "driver": "the learned driver of the 3D world, by DAgger and PPO",
}
"""What each task trains."""


def main(arguments: list[str]) -> None:
    """Run the task that is named first, with the flags behind it; without a task, say which there are."""
    task, flags = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if task in ("-h", "--help"):
        print(__doc__, *(f"  {name:15} {what}" for name, what in TASKS.items()), sep="\n")
        return
    if task not in TASKS:
        sys.exit(f"there is no task {task!r}; expected one of {', '.join(TASKS)}")
    module = import_module(f"training.train_{task}")
    run_command(module.main, module.Arguments, module.__doc__, flags)


if __name__ == "__main__":
    main(sys.argv[1:])
