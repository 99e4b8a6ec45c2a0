"""Train on recordings where no simulator can be imported: ``python -m tests.smoke.without_simulators SETTINGS``.

SETTINGS is a JSON object: ``folder``, ``data``, ``width``, ``rate``, ``epochs`` and, where they are not chosen,
``topics``. The last line printed is another one: the table of the evaluation, and the same errors of the odometry
before any training (``untrained``).
"""

import importlib.abc
import json
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

HIDDEN = ("ngo_sim", "vizdoom")


class NoSimulators(importlib.abc.MetaPathFinder):
    """Makes importing a simulator fail, as where none is installed."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


def main(settings: dict[str, Any]) -> dict[str, Any]:
    """Run every script in turn at small size, and measure the estimator before and after."""
    import torch

    from ngo_estimator.geometry import se2
    from ngo_recordings.topics import TopicArguments
    from training import evaluate, featurise, train_local, train_optimizer, train_place, train_smoother
    from training.recordings.recording_source import RecordedArguments, open_recorded
    from training.recordings.recording_streams import RecordedSteps, track_pairs
    from training.scoring.metrics import trajectory_error
    from training.scoring.online_estimate import with_origin
    from training.train_local import estimated, initial_network

    folder = Path(settings["folder"])
    recordings = RecordedArguments(
        data=tuple(map(Path, settings["data"])), name="robot", topics=TopicArguments(**settings.get("topics", {}))
    )
    places: dict[str, Any] = {"runs": folder / "runs"}
    common: dict[str, Any] = {"recordings": recordings, "precision": "32-true", **places}
    width, epochs = settings["width"], settings["epochs"]
    local = train_local.Arguments(
        width=width, epochs=epochs, learning_rate=settings["rate"], workers=0, out=folder / "weights", **common
    )
    data = open_recorded(recordings, folder / "runs")
    untrained = initial_network(local, data.domain, RecordedSteps(data, 1, 1))[0].eval()
    errors = []
    for track in data.tracks("test"):
        steps = [estimated(untrained, batch)[0] for batch in track_pairs(data.domain, track)]
        poses = with_origin(se2.r2g(torch.cat(steps)).detach().numpy())
        errors.append(trajectory_error(poses, track.poses_xyyaw).position_rmse_m)

    train_local.main(local)
    train_place.main(
        train_place.Arguments(
            width=width,
            epochs=2,
            batches=24,
            pairs_a_maze=8,
            learning_rate=3e-3,
            workers=0,
            out=folder / "weights",
            **common,
        )
    )
    featurise.main(featurise.Arguments(recordings=recordings, weights=folder / "weights", out=folder / "runs"))
    short: dict[str, Any] = {"epochs": 2, "steps": 6, "batch_size": 4, **common}
    short |= {"weights": folder / "weights", "out": folder / "weights"}
    train_smoother.main(train_smoother.Arguments(**short))
    train_optimizer.main(train_optimizer.Arguments(iterations=3, smoothing=True, **short))
    table = evaluate.main(evaluate.Arguments(recordings=recordings, weights=folder / "weights", **places))
    hidden = sorted(name for name in sys.modules if name.partition(".")[0] in HIDDEN)
    return {**table, "untrained": sum(errors) / len(errors), "simulators": hidden}


if __name__ == "__main__":
    sys.meta_path.insert(0, NoSimulators())
    print(json.dumps(main(json.loads(sys.argv[1]))))
