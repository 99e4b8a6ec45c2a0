"""What all figures of results share: a grid of panels, and how a figure becomes a file."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure


def panels(count: int, across: int, width: float, height: float) -> tuple[Figure, Iterator[Axes]]:
    """A figure with so many panels of this size (inches), ``across`` beside each other at the most."""
    columns = min(across, count)
    lines = -(-count // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(width * columns, height * lines), squeeze=False)
    for axis in axes.flat[count:]:
        axis.axis("off")
    return figure, iter(axes.flat[:count])


def save(figure: Figure, path: Path, dpi: int, tight: bool = True) -> None:
    """Write a figure into a folder that is made for it."""
    if tight:
        figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
