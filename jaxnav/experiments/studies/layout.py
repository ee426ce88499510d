"""Cut a grid into boxes of cells and trials, each run and written as one chunk."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BoxLayout:
    """A grid of cells and trials cut into boxes of one size; those at the ends may be smaller."""

    shape: tuple[int, ...]  # of the outer axes, then the trials
    box: tuple[int, ...]

    @staticmethod
    def of(shape: Sequence[int], most: int) -> "BoxLayout":
        """A layout of boxes of at most `most` trials: first one cell's, then its neighbours'."""
        room, box = max(most, 1), []
        for length in reversed(shape):
            box.append(min(length, max(room, 1)))
            room //= box[-1]
        return BoxLayout(tuple(shape), tuple(reversed(box)))

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of boxes along each axis."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.box, strict=True))

    @property
    def trials(self) -> int:
        """The number of trials in all cells."""
        return math.prod(self.shape)

    def region(self, index: Sequence[int]) -> tuple[slice, ...]:
        """The slices of the box at an index."""
        return tuple(
            slice(i * b, min((i + 1) * b, n))
            for i, b, n in zip(index, self.box, self.shape, strict=True)
        )

    def size(self, index: Sequence[int]) -> int:
        """The number of trials in the box at an index."""
        return math.prod(part.stop - part.start for part in self.region(index))

    def cells(self, index: Sequence[int]) -> Iterator[tuple[int, ...]]:
        """The cells of the box at an index, the last axis fastest."""
        *outer, _ = self.region(index)
        origin = np.array([part.start for part in outer], int)
        for offset in np.ndindex(*[part.stop - part.start for part in outer]):
            yield tuple(int(i) for i in origin + np.array(offset, int))
