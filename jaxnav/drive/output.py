"""Decouple stdout and stderr from their reader, so that they can't hold up or end a drive.

    with FreeOutput():
        print("...")      # never waits; nothing is raised where the terminal is stuck, full or gone

All output of this process to the two descriptors, also by C libraries and drivers, goes through a
pipe to a thread that reads it at once. A second thread writes it to its destination, as far as that
accepts it.
"""

import os
import queue
import sys
import threading
from contextlib import suppress

_WAITING = 1000  # pieces of at most 64 KiB in the queue: what does not fit is left out
_PATIENCE_S = 1.0  # time at the end to write what is still in the queue


class FreeOutput:
    """Context manager: inside it, writing to stdout and stderr never waits."""

    def __enter__(self) -> "FreeOutput":
        self._pumps = [_Pump(1), _Pump(2)]
        return self

    def __exit__(self, *error: object) -> None:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        for pump in self._pumps:
            pump.close()


class _Pump:
    """The pipe and the two threads of one descriptor."""

    def __init__(self, descriptor: int):
        self._descriptor, self._meant_for = descriptor, os.dup(descriptor)
        read_end, write_end = os.pipe()
        os.dup2(write_end, descriptor)
        os.close(write_end)
        self._pieces: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        self._written = threading.Event()
        threading.Thread(target=self._take, args=(read_end,), daemon=True).start()
        threading.Thread(target=self._write, daemon=True).start()

    def close(self) -> None:
        """Restore the descriptor, and wait until the queue is written, for a limited time."""
        os.dup2(self._meant_for, self._descriptor)
        self._written.wait(_PATIENCE_S)

    def _take(self, read_end: int) -> None:
        while piece := os.read(read_end, 65536):
            with suppress(queue.Full):
                self._pieces.put_nowait(piece)
        os.close(read_end)
        with suppress(queue.Full):
            self._pieces.put(None, timeout=_PATIENCE_S)

    def _write(self) -> None:
        while (piece := self._pieces.get()) is not None:
            with suppress(OSError):  # full, or gone
                while piece:
                    piece = piece[os.write(self._meant_for, piece) :]
        self._written.set()


def fill_descriptors() -> None:
    """Open closed standard streams on /dev/null, so that no later file takes their descriptors."""
    if None not in (sys.stdin, sys.stdout, sys.stderr):
        return
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
