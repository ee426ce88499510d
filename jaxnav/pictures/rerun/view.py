"""Show a drive in Rerun while it is driven, or afterwards.

    view = RerunView(rig, markers, waypoints_m, live=True, save=None)
    view.show(outcome)
    view.image("front", stamp_ns, pixels, corners_px)
    view.close()

Rerun comes with the extra `viz` and is imported when a view is opened.
"""

import importlib
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.pilot import Outcome
from jaxnav.errors import BadInput
from jaxnav.pictures.rerun.scene import Picture, RerunScene
from jaxnav.recordings.records import Outcomes

APPLICATION = "jaxnav"
_IDLE_S = 0.02  # between looks at an empty queue
_START_S = 20.0  # for the viewer's window to be there
_FLUSH_S = 5.0
_MOST_QUEUED = 200  # outcomes and images
# Drawing an outcome takes 4 ms of the interpreter, which the driving thread needs as well.
_PERIOD_NS = 100_000_000


class RerunView:
    """A window of Rerun, a file for it, or both. Any thread may call `show` and `image`.

    While a car drives, no caller waits: a thread of its own draws from a queue, and items that do
    not fit are dropped and counted. It then shows ten outcomes with corners, ten without, and ten
    frames of each camera in a second, and a new health at once.

    Attributes:
        dropped: number of outcomes and images dropped so far.
        failed: the reason why nothing is shown any more, or None.
    """

    def __init__(
        self,
        rig: CameraRig | None,
        markers: MarkerMap | None,
        waypoints_m: Float[np.ndarray, "W 2"],
        live: bool,
        save: Path | None,
        waits: bool = False,
    ):
        """Args:
        rig: None if unknown.
        markers: None if unknown.
        waypoints_m: (W, 2).
        live: open a window.
        save: an .rrd file to write.
        waits: whether `show` and `image` wait for the drawing, so that nothing is dropped.

        Raises:
            BadInput: Rerun is not installed, its window does not open, the file can't be written.
        """
        try:
            rerun = import_rerun()
        except ModuleNotFoundError:
            raise BadInput("--view", "needs rerun-sdk: pip install 'jaxnav[viz]'") from None
        self._viewer, sinks = None, []
        if save is not None:
            sinks.append(_file_sink(rerun, save))
        if live:
            self._viewer, url = _open_viewer()
            sinks.append(rerun.GrpcSink(url))
        self._stream = rerun.RecordingStream(APPLICATION)
        self._stream.set_sinks(*sinks)
        self._scene = RerunScene(rerun, self._stream, rig, markers, waypoints_m)
        self._waits = waits
        self._queue: queue.Queue[Callable[[RerunScene], None]] = queue.Queue(_MOST_QUEUED)
        self._closing = threading.Event()
        self._lock = threading.Lock()  # for the count
        self.dropped = 0
        self.failed: str | None = None
        self._shown_ns: dict[object, int] = {}
        self._thread = threading.Thread(target=self._run, name="jaxnav-viewer", daemon=True)
        if not waits:
            self._thread.start()

    def show(self, outcome: Outcome) -> None:
        """Show the pilot's outcome of an event. Never raises."""
        has_corners = outcome.data is not None and outcome.data.corners_px is not None
        if self._is_due((outcome.health, has_corners), outcome.now_ns):
            self._offer(lambda scene: scene.show(Outcomes.from_outcome(outcome)))

    def show_recorded(self, outcomes: Outcomes, index: int) -> None:
        """Show an outcome of a recorded drive. Never raises."""
        self._offer(lambda scene: scene.show(outcomes, index))

    def image(
        self,
        camera_name: str,
        stamp_ns: int,
        image: Picture | None,
        corners_px: Float[np.ndarray, "N 4 2"] | None,
    ) -> None:
        """Show a frame of a camera. Never raises.

        Args:
            image: a JPEG, or (H, W) or (H, W, 3) BGR pixels; None: unchanged.
            corners_px: (N, 4, 2) detected corners; None: unchanged.
        """
        if self._is_due(camera_name, stamp_ns):
            self._offer(lambda scene: scene.image(camera_name, stamp_ns, image, corners_px))

    def close(self) -> None:
        """Draw the queue and stop; the window stays open. May be called repeatedly."""
        if self._closing.is_set():
            return
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(_FLUSH_S)
        with suppress(Exception):  # the window may be closed by now
            self._stream.flush(timeout_sec=_FLUSH_S)
        self._stream.disconnect()

    def _is_due(self, kind: object, stamp_ns: int) -> bool:
        """Whether the last item of a kind was shown long enough ago."""
        if self._waits:
            return True
        last_ns = self._shown_ns.get(kind)
        if last_ns is not None and 0 <= stamp_ns - last_ns < _PERIOD_NS:
            return False
        self._shown_ns[kind] = stamp_ns
        return True

    def _offer(self, draw: Callable[[RerunScene], None]) -> None:
        if self._closing.is_set() or self.failed is not None:
            self._drop()
        elif self._waits:
            self._draw(draw)
        else:
            try:
                self._queue.put_nowait(draw)
            except queue.Full:
                self._drop()

    def _drop(self) -> None:
        with self._lock:
            self.dropped += 1

    def _run(self) -> None:
        while not (self._closing.is_set() and self._queue.empty()):
            with suppress(queue.Empty):
                self._draw(self._queue.get(timeout=_IDLE_S))
                time.sleep(0)  # the driving thread may have the interpreter first
            if self._viewer is not None and self._viewer.poll() is not None:
                self.failed = "the viewer was closed"
                with suppress(queue.Empty):
                    while True:
                        self._queue.get_nowait()
                        self._drop()
                return

    def _draw(self, draw: Callable[[RerunScene], None]) -> None:
        try:
            draw(self._scene)
        except Exception:  # whatever fails in drawing, the vehicle drives on
            self._drop()


def import_rerun() -> ModuleType:
    """Import Rerun: its module.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    rerun = importlib.import_module("rerun")
    importlib.import_module("rerun.blueprint")
    return rerun


def _file_sink(rerun: ModuleType, path: Path) -> Any:
    try:
        path.open("wb").close()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadInput(path, f"can't be written: {reason}") from None
    return rerun.FileSink(path)


def viewer_command(port: int) -> list[str]:
    """The command that opens a window of Rerun listening on a port of this machine."""
    own = ["--port", str(port), "--bind", "127.0.0.1", "--hide-welcome-screen"]
    return [sys.executable, "-P", "-m", "rerun_cli", *own, "--memory-limit", "2GB"]


def _open_viewer() -> tuple[subprocess.Popen[bytes], str]:
    """Open a new window: its process, and the address at which it listens."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    viewer = subprocess.Popen(
        viewer_command(port),
        # Rerun sends no usage data if it believes to run in continuous integration; the only
        # other switch is a file in the user's home.
        env=os.environ | {"CI": "true", "FORCE_RERUN_ANALYTICS": "0"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # an interrupt of the drive must not reach the window
    )
    end_s = time.monotonic() + _START_S
    while viewer.poll() is None and time.monotonic() < end_s:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return viewer, f"rerun+http://127.0.0.1:{port}/proxy"
        time.sleep(0.05)
    with suppress(OSError):  # it has ended
        os.killpg(viewer.pid, signal.SIGKILL)
    viewer.wait()
    raise BadInput("--view", "Rerun's window does not open: is there a display?")
