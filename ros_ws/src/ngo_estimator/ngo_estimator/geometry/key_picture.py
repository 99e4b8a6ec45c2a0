"""A picture as loops need it: rays to features of the place, and what each looks like."""

from dataclasses import dataclass

import numpy as np

Array = np.ndarray

MOST_FEATURES = 2000
"""Of a key picture: it bounds the time and memory that a message may cost."""

LAYOUT = 2
"""Of ``KeyPicture.packed``: saved states have it."""

_LENGTHS = (8, 512)
_HEADER = 4

_MOST = 127.0
"""The largest number of a code: all of a byte, but for -128."""


@dataclass(frozen=True, eq=False)
class KeyPicture:
    """Features of one picture.

    Attributes:
        centre: of the camera in the robot's base frame ``(3,)``, m.
        rays: unit vectors ``(n, 3)`` to the features, in base axes.
        std_rad: deviations ``(n,)`` of the rays.
        codes: directions ``(n, d)`` of the descriptors as int8, a quarter of their memory.
    """

    centre: Array
    rays: Array
    std_rad: Array
    codes: np.ndarray

    @classmethod
    def of(cls, centre: Array, rays: Array, std_rad: Array, descriptors: np.ndarray) -> "KeyPicture":
        """The picture with these ``descriptors`` ``(n, d)``, of which the direction counts."""
        largest = np.abs(descriptors).max(axis=1, keepdims=True, initial=1e-9)
        return cls(centre, rays, std_rad, np.rint(_MOST / largest * descriptors).astype(np.int8))

    @property
    def descriptors(self) -> np.ndarray:
        """Unit vectors ``(n, d)`` float32: the nearer two are, the more alike the features."""
        codes = self.codes.astype(np.float32)
        unit: np.ndarray = codes / np.maximum(np.linalg.norm(codes, axis=1, keepdims=True), 1.0)
        return unit

    def __len__(self) -> int:
        return len(self.rays)

    def packed(self) -> np.ndarray:
        """All of it in one vector ``(4 + n (4 + d),)``, as the place code of a step carries it."""
        head = (self.codes.shape[1], *self.centre)
        rows = np.concatenate((self.rays, self.std_rad[:, None], self.descriptors), axis=1)
        return np.concatenate((head, rows.ravel())).astype(np.float32)

    @classmethod
    def unpacked(cls, code: np.ndarray) -> "KeyPicture":
        """The picture of a place code; raises ``ValueError`` for one that is not a key picture's."""
        length = int(code[0]) if len(code) >= _HEADER and np.isfinite(code).all() else 0
        if not _LENGTHS[0] <= length <= _LENGTHS[1] or (len(code) - _HEADER) % (4 + length):
            raise ValueError(
                f"place_code of {len(code)} numbers is no key picture: is it from local_node with world:=camera?"
            )
        rows = code[_HEADER:].reshape(-1, 4 + length)
        rays, std_rad, descriptors = rows[:, :3].astype(np.float64), rows[:, 3].astype(np.float64), rows[:, 4:]
        if len(rows) > MOST_FEATURES or not ((std_rad > 0.0) & (std_rad < 1.0)).all():
            raise ValueError(
                f"place_code has {len(rows)} features; expected at most {MOST_FEATURES}, with deviations of 0 to 1 rad"
            )
        sizes = np.concatenate((np.linalg.norm(rays, axis=1), np.linalg.norm(descriptors, axis=1)))
        if (np.abs(sizes - 1.0) > 0.01).any():
            raise ValueError("place_code has rays or descriptors that are not unit vectors")
        return cls.of(code[1:4].astype(np.float64), rays, std_rad, descriptors)


def nothing_seen() -> KeyPicture:
    """A picture without features: it stands for one that is not known."""
    return KeyPicture(np.zeros(3), np.zeros((0, 3)), np.zeros(0), np.zeros((0, _LENGTHS[0]), np.int8))


def matches(first: KeyPicture, second: KeyPicture, ratio: float) -> np.ndarray:
    """Features that look alike and more so than others: indices ``(m, 2)``, each feature once at most.

    Args:
        ratio: the second best must be so many times as far away (Lowe 2004).
    """
    if min(len(first), len(second)) < 2 or first.codes.shape[1] != second.codes.shape[1]:
        return np.zeros((0, 2), np.int64)
    alike = first.descriptors @ second.descriptors.T
    best, back = alike.argmax(1), alike.argmax(0)
    rows = np.arange(len(first))
    top = np.partition(alike, -2, axis=1)[:, -2:]
    away = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0))
    kept = (back[best] == rows) & (away[:, 1] < ratio * away[:, 0])
    return np.stack((rows[kept], best[kept]), axis=1)
