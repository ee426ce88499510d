"""Collect the records of many drives that end at different times into arrays."""

import jax
import numpy as np
from jaxtyping import Bool, Int, PyTree


class DriveTraces:
    """The records of every drive, collected chunk by chunk as they arrive."""

    def __init__(self, count: int, chunk_frames: int):
        self.chunks = np.zeros(count, int)  # number of chunks so far, per drive
        self.chunk_frames = chunk_frames
        self.pieces: list[tuple[np.ndarray, np.ndarray, PyTree]] = []

    def add(self, owner: Int[np.ndarray, " lanes"], trace: PyTree) -> None:
        """Add one chunk, leaves (lanes, frames, ...); `owner` is each lane's drive, -1 for none."""
        lanes = np.flatnonzero(owner >= 0)
        drive = owner[lanes]
        piece = jax.tree.map(lambda leaf: leaf[lanes], trace)
        self.pieces.append((drive, self.chunks[drive], piece))
        self.chunks[drive] += 1

    def stack(self) -> tuple[PyTree, Bool[np.ndarray, "S frames"]]:
        """Stack drives of unequal lengths; an ended drive repeats its last frame.

        Returns:
            The records, leaves (drives, frames, ...), and a mask of each drive's own frames.
        """
        count, most, length = len(self.chunks), self.chunks.max(), self.chunk_frames

        def joined(*leaves: np.ndarray) -> np.ndarray:
            whole = np.zeros((count, most, *leaves[0].shape[1:]), leaves[0].dtype)
            for (drive, number, _), leaf in zip(self.pieces, leaves, strict=True):
                whole[drive, number] = leaf
            return whole.reshape(count, most * length, *leaves[0].shape[2:])

        kept = jax.tree.map(joined, *(piece for _, _, piece in self.pieces))
        frames, own = np.arange(most * length)[None], (self.chunks * length)[:, None]
        last = np.minimum(frames, own - 1)
        return jax.tree.map(lambda leaf: leaf[np.arange(count)[:, None], last], kept), frames < own
