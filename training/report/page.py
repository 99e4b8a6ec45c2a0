"""What all pages of results are made of: tables of rows and columns, numbers with their intervals, and figures."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Entry = Mapping[str, Any]  # ``{mean, ci95}``; the interval may be None.


@dataclass(frozen=True)
class Column:
    """A metric as a column: its key in the JSON, its title, and how a value is written, which ``scale`` multiplies."""

    key: str
    title: str
    digits: Callable[[float], str]
    scale: float = 1.0

    def cell(self, numbers: Mapping[str, Entry]) -> str:
        """The cell of a row; empty where it has no such number."""
        return with_interval(numbers.get(self.key), self.digits, self.scale)


def table(rows: Mapping[str, Mapping[str, Entry]], shown: Sequence[Column], first: str = "") -> str:
    """A line for each row, by its title, below the columns; ``first`` is the title of the rows."""
    lines = ([title, *(column.cell(numbers) for column in shown)] for title, numbers in rows.items())
    return markdown([first, *(column.title for column in shown)], lines)


def markdown(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def with_interval(entry: Entry | None, digits: Callable[[float], str], scale: float = 1.0) -> str:
    """A mean, and its interval in brackets where it has one; empty without a mean."""
    if entry is None or entry["mean"] is None:
        return ""
    mean = digits(scale * entry["mean"])
    if entry["ci95"] is None:
        return mean
    low, high = (digits(scale * value) for value in entry["ci95"])
    return f"{mean} [{low}, {high}]"


def interval(entry: Entry) -> str:
    """A mean with its interval, of three significant digits."""
    return with_interval(entry, number)


def number(value: float) -> str:
    """Three significant digits, without an exponent."""
    magnitude = abs(value)
    digits = 0 if magnitude >= 100 else 1 if magnitude >= 10 else 2 if magnitude >= 1 else 3
    if 0 < magnitude < 0.1:
        digits = 4 if magnitude >= 0.01 else 5
    return f"{value:.{digits}f}"


def short(value: float) -> str:
    """Three significant digits, without zeros behind them."""
    return f"{value:.3g}"


def signed(digits: int) -> Callable[[float], str]:
    """So many digits behind the point, and always a sign."""
    return lambda value: f"{value:+.{digits}f}"


def joined(values: Iterable[object]) -> str:
    """``a, b and c``."""
    *most, last = map(str, values)
    return f"{', '.join(most)} and {last}" if most else last


def figures(images: Mapping[str, str]) -> list[str]:
    """The parts of a page that show the files in ``images/``, each with its caption; none without any."""
    shown = [f"![{caption}](images/{name})\n\n{caption}" for name, caption in images.items()]
    return ["## Figures", *shown] if shown else []


def page(parts: Iterable[str]) -> str:
    """The text of a page; empty parts are left out."""
    return "\n\n".join(part for part in parts if part) + "\n"
