"""Segments of a chain of key scans, and the parts of the map that loops make of them.

Nobody measured the step from a segment to the next: only loops between two segments tell how they lie.
"""

import numpy as np


def segment_of(segments: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """The segment of each node, an array of the shape of ``nodes``; ``segments`` ``(s,)`` are their first nodes."""
    found: np.ndarray = np.searchsorted(segments, nodes, side="right") - 1
    return found


def joined_parts(segments: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """The part of the map ``(s,)`` that each segment is in, by the number of the part's first segment.

    Args:
        segments: the first node of each segment ``(s,)``.
        pairs: nodes ``(n, 2)`` that believed loops join.
    """
    part = np.arange(len(segments))
    if len(segments) == 1:
        return part
    for a, b in np.unique(segment_of(segments, pairs), axis=0).tolist():
        if part[a] != part[b]:
            low, high = sorted((int(part[a]), int(part[b])))
            part[part == high] = low
    return part


def anchors(segments: np.ndarray, parts: np.ndarray, ranks: np.ndarray) -> np.ndarray:
    """The node ``(s,)`` that is the origin of the part of the map in which each segment is.

    It is the first node of the segment of the lowest rank, of those of one rank the first.

    Args:
        segments: the first node of each segment ``(s,)``; parts: as ``joined_parts`` gives them.
        ranks: of each segment ``(s,)``.
    """
    order = np.lexsort((segments, ranks))
    _, first, which = np.unique(parts[order], return_index=True, return_inverse=True)
    found = np.empty_like(segments)
    found[order] = segments[order[first[which]]]
    return found
