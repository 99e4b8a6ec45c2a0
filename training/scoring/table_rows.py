"""The rows of the tables of results, and the places of their networks, features and settings."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ngo_estimator.checkpoint import LOCAL
from training.baselines.deepvo import DEEPVO
from training.data.worlds import World


@dataclass(frozen=True)
class Row:
    """A row of a table: what it is in words, and how it comes about.

    ``form`` and ``iterations`` describe the optimizer that is trained for the row, with several seeds. With
    ``own_networks`` the row has networks and features of its own. ``registered`` rows take the odometry after its
    steps were registered again, ``smoothed`` rows take it as our optimizer smooths it; neither uses our optimizer.
    ``odometry`` is the kind of network of a row that is odometry alone. ``worlds`` have the row; none: all of them.
    """

    title: str
    form: Literal["loops", "gauss_newton", "paper"] | None = None
    iterations: int = 0
    own_networks: bool = False
    registered: bool = False
    smoothed: bool = False
    odometry: str | None = None
    worlds: tuple[str, ...] = ()


ROWS = {
    "local": Row("odometry of the local network"),
    "registered": Row("odometry, each meta-step measured again by registering scans; no loops", registered=True),
    "smoothed": Row("odometry, smoothed as in our optimizer; no loops", smoothed=True),
    "local_no_action": Row(
        "odometry of a local network that does not take the actions", odometry=LOCAL, worlds=("maze3d",)
    ),
    "deepvo": Row("DeepVO (Wang et al., 2017), trained on the same data", odometry=DEEPVO, worlds=("maze3d",)),
    "paper_1": Row("the paper's optimizer, 1 iteration", "paper", 1),
    "paper_5": Row("the paper's optimizer, 5 iterations", "paper", 5),
    "ngo_1": Row("our optimizer, 1 iteration", "loops", 1),
    "ngo_5": Row("our optimizer, 5 iterations", "loops", 5),
    "gauss_newton": Row("differentiable Gauss-Newton with learned gates alone", "gauss_newton", 5),
    "end_to_end": Row("`ngo_5` of seed 0, all networks fine-tuned together", own_networks=True),
    "gtsam": Row("robust pose graph (GTSAM), same odometry and loops, tuned on validation"),
    "gtsam_registered": Row("`gtsam` on the odometry of `registered`, with settings of its own", registered=True),
    "gtsam_smoothed": Row("`gtsam` on the odometry of `smoothed`, with settings of its own", smoothed=True),
}


def rows_of(world: World) -> list[str]:
    """The rows of a world's tables, in order."""
    return [
        name
        for name, row in ROWS.items()
        if (not row.worlds or world.name in row.worlds)
        and (world.registers_odometry or not row.registered)
        and (world.smoothing or not row.smoothed)
    ]


def trainings_of(row: str, seeds: int) -> int:
    """How many trainings a row has, where optimizers have so many."""
    kind = ROWS[row]
    return seeds if kind.form is not None else int(kind.own_networks or kind.odometry is not None)


@dataclass(frozen=True)
class Sources:
    """Where networks, features and settings lie.

    ``weights`` holds ``WORLD/*.safetensors`` of the local network and the place encoder, ``runs`` holds
    ``WORLD/features/`` and ``WORLD/rows/ROW-seedN/``, ``results`` holds ``WORLD.gtsam.json``.
    """

    world: World
    weights: Path
    runs: Path
    results: Path

    @property
    def networks(self) -> Path:
        return self.weights / self.world.name

    def row_folder(self, row: str, seed: int) -> Path:
        """Folder of the weights that are trained for a row."""
        return self.runs / self.world.name / "rows" / f"{row}-seed{seed}"

    def store_folder(self, split: str, table: str) -> Path:
        """Folder of the features of a table's mazes."""
        return self.runs / self.world.name / "features" / f"{split}_{table}"

    def settings_file(self, form: str = "loops") -> Path:
        """The pose graph's settings in one of its ``tune_pose_graph.FORMS``, tuned on validation."""
        return self.results / f"{self.world.name}.gtsam{'' if form == 'loops' else f'_{form}'}.json"

    def of_row(self, row: str, seed: int) -> "Sources":
        """The sources of a row with networks and features of its own."""
        folder = self.row_folder(row, seed)
        return replace(self, weights=folder, runs=folder)
