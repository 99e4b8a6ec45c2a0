"""Which key pictures look alike: each in one vector of residuals to words of a vocabulary (VLAD, Jegou et al. 2010)."""

from collections.abc import Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from ngo_estimator.data.row_buffers import SlidingRows
from ngo_estimator.data.state_arrays import Arrays, taken
from ngo_estimator.geometry.key_picture import KeyPicture

_ITERATIONS = 10
_SEED = 1
_LEAST_FEATURES = 4
"""For each word."""


class PicturePlaces:
    """Vectors of key pictures. The vocabulary is made of the first pictures, so that nothing is trained before.

    Args:
        words: of the vocabulary; pictures: so many of the first ones make it.
        most: so many of the newest key pictures are compared.
    """

    def __init__(self, words: int, pictures: int, most: int) -> None:
        self._count, self._first, self._most = words, pictures, most
        self._words = np.zeros((0, 0), np.float32)
        self._vectors = SlidingRows((0,), np.float32, most)

    def append(self, pictures: Sequence[KeyPicture]) -> None:
        """Take in the last of all key pictures."""
        if len(self._words):
            self._vectors.append(self._vector(pictures[-1]))
        elif len(pictures) >= self._first:
            seen = np.concatenate([picture.descriptors for picture in pictures if len(picture)] or [self._words])
            if len(seen) >= _LEAST_FEATURES * self._count:
                self._words = kmeans2(seen, self._count, _ITERATIONS, minit="++", rng=_SEED)[0].astype(np.float32)
                self.rebuild(pictures)

    def rebuild(self, pictures: Sequence[KeyPicture]) -> None:
        """Compute the vectors of all key pictures anew."""
        self._vectors = SlidingRows((self._words.size,), np.float32, self._most)
        for picture in pictures if len(self._words) else ():
            self._vectors.append(self._vector(picture))

    def alike(self, picture: KeyPicture) -> np.ndarray:
        """How alike a picture is to each key picture ``(n,)``; those that are not compared have -inf.

        None before there is a vocabulary.
        """
        count = len(self._vectors)
        first, found = max(0, count - self._most), np.full(count, -np.inf)
        if count:
            found[first:] = self._vectors.slice(first) @ self._vector(picture)
        return found

    def _vector(self, picture: KeyPicture) -> np.ndarray:
        words = self._words
        summed = np.zeros_like(words)
        descriptors = picture.descriptors
        if descriptors.shape[1] == words.shape[1] and len(picture):
            nearest = (descriptors @ words.T - 0.5 * (words**2).sum(1)).argmax(1)
            np.add.at(summed, nearest, descriptors - words[nearest])
            summed /= np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-9)
        vector = summed.ravel()
        shorter: np.ndarray = vector / max(float(np.linalg.norm(vector)), 1e-9)
        return shorter

    def state(self) -> Arrays:
        """The vocabulary, for ``restore``; vectors follow from it and the pictures (``rebuild``)."""
        return {"words": self._words.copy()}

    def restore(self, arrays: Arrays) -> None:
        """Take the vocabulary of a ``state()``; raises ``StateError``."""
        self._words = taken(arrays, "words", np.dtype(np.float32), -1, -1)
