"""The rows of the tables of results, and where what they need lies."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ngo_estimator.checkpoint import LOCAL
from ngo_estimator.networks.compass import COMPASS
from training.baselines.deepvo import DEEPVO
from training.data.worlds import World


@dataclass(frozen=True)
class Row:
    """A row of a table: what it is in words, and how it comes about.

    ``form``, ``iterations`` and ``learning_rate`` (None: the script's own) are what is trained for it, with several
    seeds. With ``compass`` it takes the readings of a compass. With ``own_networks`` all its networks are its own, and
    so are its features. ``registered`` is what takes the odometry that was registered again, without our optimizer, and
    ``smoothed`` what takes the odometry as our optimizer smooths it.
    ``odometry`` is the kind of a network of its own whose relative poses are all there is to it. ``worlds`` have the
    row; none: all of them.
    """

    title: str
    form: Literal["loops", "gauss_newton", "paper"] | None = None
    iterations: int = 0
    compass: bool = False
    learning_rate: float | None = None
    own_networks: bool = False
    registered: bool = False
    smoothed: bool = False
    odometry: str | None = None
    worlds: tuple[str, ...] = ()


COMPASS_WORLDS = ("maze2d",)
"""Worlds with a lattice, in which a compass can be trained."""

ROWS = {
    "local": Row("odometry of the local network"),
    "local_calibrated": Row("the same, with a constant bias and gain fitted on validation"),
    "registered": Row("odometry, each meta-step measured again by registering scans; no loops", registered=True),
    "smoothed": Row("odometry, smoothed as in our optimizer; no loops", smoothed=True),
    "local_no_action": Row(
        "odometry of a local network that is not told the actions", odometry=LOCAL, worlds=("maze3d",)
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
    "true_pairs": Row("GTSAM with true revisits, measured by our pair head"),
    "oracle": Row("GTSAM with true revisits, measured exactly"),
    "ngo_1_compass": Row("`ngo_1` with a compass", "loops", 1, compass=True, learning_rate=1e-4, worlds=COMPASS_WORLDS),
    "ngo_5_compass": Row("`ngo_5` with a compass", "loops", 5, compass=True, learning_rate=1e-4, worlds=COMPASS_WORLDS),
    "gtsam_compass": Row("`gtsam` with a compass, tuned on validation", compass=True, worlds=COMPASS_WORLDS),
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
    ``WORLD/features/`` and ``WORLD/rows/ROW-seedN/``, ``results`` holds ``WORLD.gtsam.json``. With ``has_compass`` the
    features hold the readings of a compass.
    """

    world: World
    weights: Path
    runs: Path
    results: Path
    has_compass: bool = False

    @property
    def networks(self) -> Path:
        return self.weights / self.world.name

    @property
    def compass_weights(self) -> Path:
        """The folder with ``WORLD/compass.safetensors``: no part of what the estimator's package ships."""
        shipped = self.networks / f"{COMPASS}.safetensors"
        return self.weights if shipped.exists() else self.runs / COMPASS

    def row_folder(self, row: str, seed: int) -> Path:
        """Folder of the weights that are trained for a row."""
        return self.runs / self.world.name / "rows" / f"{row}-seed{seed}"

    def store_folder(self, split: str, table: str) -> Path:
        """Folder of the features of a table's mazes."""
        return self.runs / self.world.name / "features" / f"{split}_{table}"

    def settings_file(self, form: str = "loops") -> Path:
        """The pose graph's settings in one of its ``tune_pose_graph.FORMS``, tuned on validation."""
        return self.results / f"{self.world.name}.gtsam{'' if form == 'loops' else f'_{form}'}.json"

    @property
    def speed_file(self) -> Path:
        """How fast data is made, as measured once."""
        return self.runs / self.world.name / "results" / "throughput.json"

    def of_row(self, row: str, seed: int) -> "Sources":
        """The same for a row that has networks and features of its own, and no compass."""
        folder = self.row_folder(row, seed)
        return replace(self, weights=folder, runs=folder, has_compass=False)
