"""What mazes of the 3D world look like: as they are trained in, and as networks are measured in."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

LooksName = Literal["plain", "varied"]

HELD_OUT = "industrial"
"""The set of textures (``ngo_sim.doom_map.TEXTURE_SETS``) that no looks of a training have."""


@dataclass(frozen=True)
class Looks:
    """Ranges, both ends included, from which settings of ``ngo_sim.maze3d.Maze3DConfig`` are drawn by these names.

    They are drawn for a group of mazes at once, with one of the sets of ``textures`` for all of them. The default is
    the simulator's own light and corridors of its own width, without decorations.
    """

    textures: tuple[str, ...] = ("all",)
    light_level: tuple[int, int] = (208, 208)
    block_m: tuple[float, float] = (3.0, 3.0)
    decorations: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if not self.textures:
            raise ValueError("textures is (); expected the name of one set or more")
        for name in ("light_level", "block_m", "decorations"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise ValueError(f"{name} is {(low, high)}; expected a lower end from 0 and an upper one not below it")

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """One look: the settings of the simulator. Widths are whole centimetres."""
        return {
            "textures": self.textures[int(rng.integers(len(self.textures)))],
            "light_level": int(rng.integers(self.light_level[0], self.light_level[1] + 1)),
            "block_m": round(float(rng.uniform(*self.block_m)), 2),
            "decorations": int(rng.integers(self.decorations[0], self.decorations[1] + 1)),
        }


TRAINING_LOOKS: dict[LooksName, Looks] = {
    "plain": Looks(("stone",)),
    "varied": Looks(("stone", "brick", "tech"), light_level=(128, 255), block_m=(2.4, 3.6), decorations=(0, 40)),
}
"""What networks can be trained in by name (``--looks`` of ``train_local`` and ``train_place``)."""

MEASURED_LOOKS: dict[str, Looks] = {
    "plain": TRAINING_LOOKS["plain"],
    "held_out": dataclasses.replace(TRAINING_LOOKS["plain"], textures=(HELD_OUT,)),
    "held_out_varied": dataclasses.replace(TRAINING_LOOKS["varied"], textures=(HELD_OUT,)),
}
"""What ``ablate_looks`` measures networks in."""


def check_looks(world: str | None, looks: object) -> None:
    """Raise ``ValueError`` where looks are given and the world (None: recordings) has none."""
    if looks is not None and world != "maze3d":
        raise ValueError(f"looks is {looks!r} with {world or 'recordings'}; expected none: only maze3d has looks")
