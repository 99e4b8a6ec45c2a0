"""Planar pose graphs as g2o files: ``VERTEX_SE2``, ``EDGE_SE2`` and ``FIX``.

Marks stand in comments behind a line, where other programs read on to its end: ``# loop 0.97`` behind an edge that is a
loop, with how much it is believed, ``# step 0`` behind a step that is not believed, ``# stamp 12.5`` (s) behind a
vertex. What is written is read back to the last bit.
"""

import gzip
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path

import numpy as np

from ngo_estimator.geometry.se2 import between
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.slam.trajectory_update import Trajectory
from ngo_estimator.trajectory.files import write_lines

GRAPH_ENDING = ".g2o"  # Of the files of this module.

UNSTAMPED = -1  # Stamp of a vertex that has none.

_NS = 1_000_000_000
_VERTEX, _EDGE, _FIX = "VERTEX_SE2", "EDGE_SE2", "FIX"
_FORMS = {_VERTEX: "id x y yaw", _EDGE: "from to x y yaw and six values of the information matrix"}
_IDS, _VALUES = {_VERTEX: 1, _EDGE: 2}, {_VERTEX: 3, _EDGE: 9}
_AT_ONCE = 50_000  # lines whose words wait for their conversion
_LARGEST = 1e12  # m or rad, of a pose: squares of larger ones overflow
_UPPER = np.triu_indices(3)
_EDGE_MARK = re.compile(r"(loop|step)(?: ([01](?:\.\d*)?|\d(?:\.\d*)?e-\d{1,3}))?$")
_STAMP_MARK = re.compile(r"stamp (\d{1,10}(?:\.\d{1,9})?)$")
_LEAST_EIGENVALUE = 1e-12  # of an information matrix whose diagonal is one


@dataclass(frozen=True)
class PlanarGraph:
    """Vertices and edges of a plane.

    ``ids`` ``(n,)`` name the vertices, ``poses`` ``(n, 3)`` (m, m, rad) are where they lie; ``stamps_ns`` ``(n,)`` is
    ``UNSTAMPED`` where nobody knows. ``edges`` ``(m, 2)`` are ids: ``relative`` ``(m, 3)`` is the second as seen from
    the first, with ``information`` ``(m, 3, 3)`` along the first's axes, positive definite but for rows and columns of
    zeros, of which nobody knows anything. ``is_loop`` ``(m,)`` marks loops, ``belief`` ``(m,)``, zero to one, is NaN
    where nothing is said. ``fixed`` are the ids that stay where they are, ``remarks`` what was not read.
    ``ranks`` ``(n,)`` name the drive of each vertex where there are several.
    """

    ids: np.ndarray
    poses: np.ndarray
    stamps_ns: np.ndarray
    edges: np.ndarray
    relative: np.ndarray
    information: np.ndarray
    is_loop: np.ndarray
    belief: np.ndarray
    fixed: tuple[int, ...] = ()
    remarks: tuple[str, ...] = ()
    ranks: np.ndarray | None = None

    def with_beliefs(self, poses: np.ndarray, is_loop: np.ndarray, belief: np.ndarray) -> "PlanarGraph":
        """The same graph after it was corrected."""
        return replace(self, poses=poses, is_loop=is_loop, belief=belief)


def graph_of(
    stamps_ns: np.ndarray, poses: np.ndarray, steps: RelativePoses, loops: RelativePoses, belief: np.ndarray
) -> PlanarGraph:
    """The graph of a trajectory, whose vertices are counted from 0 on, with the belief in each of its loops."""
    parts = steps, loops
    of_steps, of_loops = len(steps), len(loops)
    return PlanarGraph(
        ids=np.arange(len(poses)),
        poses=poses,
        stamps_ns=stamps_ns,
        edges=np.concatenate([part.nodes for part in parts]),
        relative=np.concatenate([part.relative for part in parts]),
        information=np.concatenate([part.information for part in parts]),
        is_loop=np.arange(of_steps + of_loops) >= of_steps,
        belief=np.concatenate((np.full(of_steps, np.nan), belief)),
    )


def graph_of_frames(trajectory: Trajectory) -> PlanarGraph:
    """The graph of all frames: steps as the odometry measured them, and loops, in whose information the belief counts.

    What an optimizer makes of a step (smoothing, adjustments, how far it may bend) is in the poses alone.
    """
    relative = between(trajectory.odometry_xyyaw[:-1], trajectory.odometry_xyyaw[1:])
    frames = np.arange(len(relative))
    ends = np.stack((frames, frames + 1), axis=1)
    steps = RelativePoses.of_deviations(ends, relative, trajectory.odometry_std.astype(np.float64))
    loops = RelativePoses.of_deviations(trajectory.loops, trajectory.loop_relative_xyyaw, trajectory.loop_std)
    return graph_of(trajectory.stamps_ns, trajectory.poses_xyyaw, steps, loops, trajectory.loop_weights)


def write_g2o(path: Path, graph: PlanarGraph) -> None:
    """Write a graph, all at once or not at all.

    Raises:
        ValueError: the file does not end in ``.g2o``, or something is at its place that is no regular file.
        OSError: it cannot be written; one that was there before still is.
    """
    if path.suffix != GRAPH_ENDING:
        raise ValueError(f"file is '{path}'; expected a name that ends in {GRAPH_ENDING}")
    write_lines({path: g2o_lines(graph)})


def g2o_lines(graph: PlanarGraph) -> Iterator[str]:
    """The lines of a graph's file."""
    vertices = zip(graph.ids.tolist(), graph.poses.tolist(), graph.stamps_ns.tolist(), strict=True)
    for name, (x, y, yaw), stamp in vertices:
        mark = "" if stamp == UNSTAMPED else f" # stamp {stamp // _NS}.{stamp % _NS:09d}"
        yield f"{_VERTEX} {name} {x!r} {y!r} {yaw!r}{mark}"
    information = graph.information[:, _UPPER[0], _UPPER[1]]
    values = np.concatenate((graph.relative, information), axis=1)
    edges = zip(graph.edges.tolist(), values.tolist(), graph.is_loop.tolist(), graph.belief.tolist(), strict=True)
    for (first, second), numbers, is_loop, belief in edges:
        said = "" if belief != belief else f" {belief!r}"  # NaN
        mark = f" # loop{said}" if is_loop else f" # step{said}" if said else ""
        yield f"{_EDGE} {first} {second} {' '.join(map(repr, numbers))}{mark}"
    for name in graph.fixed:  # last, as GTSAM reads no edge behind it
        yield f"{_FIX} {name}"


def read_g2o(path: Path) -> PlanarGraph:
    """Read a graph; files that end in ``.gz`` are unpacked.

    An edge may join vertices that have no line: these are not among ``ids``.

    Raises:
        ValueError: a line that is none of a planar graph, values that are not finite, an information matrix that no
            errors have, or no edge at all; it names file and line.
        OSError: the file cannot be read.
    """
    try:
        with gzip.open(path, "rt", encoding="utf-8") if path.suffix == ".gz" else path.open(encoding="utf-8") as lines:
            return _read(enumerate(lines, start=1))
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no text; expected a g2o file") from None
    except (EOFError, gzip.BadGzipFile) as error:
        raise ValueError(f"{path} cannot be unpacked: {error}") from None
    except ValueError as error:
        raise ValueError(f"{path}, {error}") from None


class _Lines:
    """Lines of one tag, turned into numbers many at a time."""

    def __init__(self, tag: str) -> None:
        self._tag = tag
        self._words: list[list[str]] = []
        self._numbers: list[int] = []
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def take(self, number: int, words: list[str]) -> None:
        if len(words) != 1 + _IDS[self._tag] + _VALUES[self._tag]:
            raise ValueError(f"line {number} has {len(words)} words; expected {self._tag} {_FORMS[self._tag]}")
        self._words.append(words)
        self._numbers.append(number)
        if len(self._words) >= _AT_ONCE:
            self._convert()

    def _convert(self) -> None:
        ids, values = _numbers(self._tag, self._words, self._numbers)
        self._parts.append((ids, values, np.array(self._numbers, np.int64)))
        self._words, self._numbers = [], []

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ids ``(n, k)``, values ``(n, v)``, and the lines' numbers ``(n,)``."""
        self._convert()
        ids, values, numbers = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        return ids, values, numbers


def _numbers(tag: str, words: list[list[str]], lines: list[int]) -> tuple[np.ndarray, np.ndarray]:
    names, count = _IDS[tag], len(words)
    try:
        ids = np.array([line[1 : 1 + names] for line in words], np.int64).reshape(count, names)
        values = np.array([line[1 + names :] for line in words], np.float64).reshape(count, _VALUES[tag])
    except (ValueError, OverflowError):
        if count == 1:
            raise ValueError(f"line {lines[0]} is '{' '.join(words[0])[:80]}'; expected {tag} {_FORMS[tag]}") from None
        half = count // 2  # only where there is a fault: the line that has it is looked for
        _numbers(tag, words[:half], lines[:half])
        _numbers(tag, words[half:], lines[half:])
        raise
    sane = np.isfinite(values).all(1) & (np.abs(values[:, :3]) <= _LARGEST).all(1)
    if not sane.all():
        raise ValueError(
            f"line {lines[int(sane.argmin())]} has a value that is not finite, or a pose beyond {_LARGEST:g}; "
            "expected metres and radians"
        )
    return ids, values


def _read(lines: Iterator[tuple[int, str]]) -> PlanarGraph:
    parts = {tag: _Lines(tag) for tag in (_VERTEX, _EDGE)}
    marks: list[tuple[bool, float]] = []
    stamps: list[int] = []
    fixed: dict[int, int] = {}
    others: dict[str, int] = {}
    for number, line in lines:
        content, _, comment = line.partition("#")
        words = content.split()
        if not words:
            continue
        tag = words[0]
        if tag == _VERTEX:
            stamps.append(_stamp(number, comment))
        elif tag == _EDGE:
            marks.append(_mark(number, comment))
        elif tag == _FIX:
            fixed.update(dict.fromkeys(_fixed(number, words), number))
            continue
        elif tag.startswith(("VERTEX", "EDGE")):
            raise ValueError(f"line {number} is a {tag}; expected a planar graph: {_VERTEX}, {_EDGE}, {_FIX}")
        else:
            others[tag] = others.get(tag, 0) + 1
            continue
        parts[tag].take(number, words)
    (ids, poses, at_vertex), (edges, values, at_edge) = (part.arrays() for part in parts.values())
    if len(edges) == 0:
        raise ValueError(f"there is no {_EDGE}; expected a planar pose graph")
    information = np.zeros((len(edges), 3, 3))
    information[:, _UPPER[0], _UPPER[1]] = information[:, _UPPER[1], _UPPER[0]] = values[:, 3:]
    _check(ids[:, 0], at_vertex, edges, at_edge, information, fixed)
    return PlanarGraph(
        ids[:, 0], poses, np.array(stamps, np.int64), edges, values[:, :3], information,
        np.array([is_loop for is_loop, _ in marks]), np.array([belief for _, belief in marks]), tuple(fixed),
        tuple(f"{count} lines of {tag} were not read" for tag, count in others.items()),
    )  # fmt: skip


def _check(
    ids: np.ndarray,
    at_vertex: np.ndarray,
    edges: np.ndarray,
    at_edge: np.ndarray,
    information: np.ndarray,
    fixed: dict[int, int],
) -> None:
    """Raise ``ValueError`` for what makes no graph; ``at_`` are the numbers of lines."""
    first = np.unique(ids, return_index=True)[1]
    if len(first) < len(ids):
        again = int(np.setdiff1d(np.arange(len(ids)), first)[0])
        raise ValueError(f"line {at_vertex[again]} has the vertex {ids[again]} again; expected each once")
    if (same := edges[:, 0] == edges[:, 1]).any():
        row = int(same.argmax())
        raise ValueError(f"line {at_edge[row]} joins the vertex {edges[row, 0]} with itself; expected two vertices")
    diagonal = np.einsum("kii->ki", information)
    unknown = diagonal == 0.0
    # Of what nobody knows there is a row of zeros; the rest is judged with a diagonal of ones.
    size = np.where(diagonal > 0.0, np.sqrt(np.abs(diagonal)), 1.0)
    even = information / (size[:, :, None] * size[:, None, :]) + unknown[:, None, :] * np.eye(3)
    wrong = ~np.isfinite(even).all((1, 2)) | (unknown[:, :, None] & (information != 0.0)).any((1, 2))
    wrong |= (diagonal < 0.0).any(1) | unknown.all(1)
    wrong[~wrong] = np.linalg.eigvalsh(even[~wrong])[:, 0] < _LEAST_EIGENVALUE
    if wrong.any():
        row = int(wrong.argmax())
        values = " ".join(f"{value:g}" for value in information[row][_UPPER])
        raise ValueError(
            f"line {at_edge[row]} has the information {values}; expected a positive definite matrix, or rows and "
            "columns of zeros where nothing was measured"
        )
    known = np.union1d(ids, edges)
    for name, number in fixed.items():
        if name not in known:
            raise ValueError(f"line {number} fixes the vertex {name}, which is not there")


def _stamp(number: int, comment: str) -> int:
    said = " ".join(comment.split())
    if not said.startswith("stamp"):
        return UNSTAMPED
    if (found := _STAMP_MARK.match(said)) is None:
        raise ValueError(f"line {number} ends in '# {said[:40]}'; expected '# stamp' and seconds")
    return int(Decimal(found[1]) * _NS)


def _mark(number: int, comment: str) -> tuple[bool, float]:
    """Whether an edge is marked as a loop, and the belief in it."""
    said = " ".join(comment.split())
    if not said.startswith(("loop", "step")):
        return False, float("nan")
    found = _EDGE_MARK.match(said)
    if found is None or float(found[2] or 0.0) > 1.0:
        raise ValueError(f"line {number} ends in '# {said[:40]}'; expected '# loop' or '# step' and a belief of 0 to 1")
    return found[1] == "loop", float(found[2]) if found[2] else float("nan")


def _fixed(number: int, words: list[str]) -> list[int]:
    try:
        names = [int(word) for word in words[1:]]
    except ValueError:
        names = []
    if not names:
        raise ValueError(f"line {number} is '{' '.join(words)[:80]}'; expected {_FIX} and the id of a vertex")
    return names
