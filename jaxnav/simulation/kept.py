"""What is kept of many drives that end at different times, as arrays side by side."""

from typing import Any

import jax
import numpy as np


class Kept:
    """What was kept of every drive, chunk by chunk as it comes in."""

    def __init__(self, count: int, chunk_frames: int):
        self.chunks = np.zeros(count, int)  # of each drive
        self.chunk_frames = chunk_frames
        self.pieces: list[tuple[np.ndarray, np.ndarray, Any]] = []

    def take(self, owner: np.ndarray, trace: Any) -> None:
        """One chunk, leaves (lanes, frames, ...), of the drives that own a lane; -1 owns none."""
        taken = np.flatnonzero(owner >= 0)
        drive = owner[taken]
        piece = jax.tree.map(lambda leaf: leaf[taken], trace)
        self.pieces.append((drive, self.chunks[drive], piece))
        self.chunks[drive] += 1

    def side_by_side(self) -> tuple[Any, np.ndarray]:
        """Unequal lengths as one array: what is over stays as it was.

        Returns:
            What was kept, leaves (drives, frames, ...), and which frames a drive has had itself.
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
