"""Which key pictures look alike: each in one vector of residuals to words of a vocabulary (VLAD, Jegou et al. 2010)."""

import numpy as np
from scipy.cluster.vq import kmeans2

from ngo_estimator.data.state_arrays import Arrays, taken
from ngo_estimator.geometry.key_picture import KeyPicture

_ITERATIONS = 10
_SEED = 1


class PicturePlaces:
    """Vectors of key pictures. The vocabulary is made of the first pictures, so that nothing is trained before.

    Args:
        words: of the vocabulary; pictures: so many of the first ones make it.
    """

    def __init__(self, words: int, pictures: int) -> None:
        self._count, self._first = words, pictures
        self._words = np.zeros((0, 0), np.float32)
        self._vectors: list[np.ndarray] = []

    def append(self, pictures: list[KeyPicture]) -> None:
        """Take in the last of all key pictures."""
        if not len(self._words) and len(pictures) >= self._first:
            seen = np.concatenate([picture.descriptors for picture in pictures if len(picture)])
            if len(seen) >= 4 * self._count:
                self._words = kmeans2(seen, self._count, _ITERATIONS, minit="++", rng=_SEED)[0].astype(np.float32)
                self._vectors = [self._vector(picture) for picture in pictures[:-1]]
        if len(self._words):
            self._vectors.append(self._vector(pictures[-1]))

    def alike(self) -> np.ndarray:
        """How alike each earlier key picture is to the last one ``(n,)``, -1 to 1; none without a vocabulary yet."""
        if len(self._vectors) < 2:
            return np.zeros(0, np.float32)
        return np.stack(self._vectors[:-1]) @ self._vectors[-1]

    def _vector(self, picture: KeyPicture) -> np.ndarray:
        words = self._words
        summed = np.zeros_like(words)
        if picture.descriptors.shape[1] == words.shape[1] and len(picture):
            nearest = (picture.descriptors @ words.T - 0.5 * (words**2).sum(1)).argmax(1)
            np.add.at(summed, nearest, picture.descriptors - words[nearest])
            summed /= np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-9)
        vector = summed.ravel()
        shorter: np.ndarray = vector / max(float(np.linalg.norm(vector)), 1e-9)
        return shorter

    def state(self) -> Arrays:
        """The vocabulary, for ``restore``; vectors follow from it."""
        return {"words": self._words.copy()}

    def restore(self, arrays: Arrays) -> None:
        """Take the vocabulary of a ``state()``; raises ``StateError``."""
        self._words = taken(arrays, "words", np.dtype(np.float32), -1, -1)

    def rebuilt(self, pictures: list[KeyPicture]) -> None:
        """Compute the vectors of all key pictures anew."""
        self._vectors = [self._vector(picture) for picture in pictures] if len(self._words) else []
