"""Render the images of the simulated car's cameras in a process of their own.

    python -P -m jaxnav.vehicles.rendering_process CONNECTION    # a file descriptor

Rendering takes more of a core than a car's computer has to spare, and holds the interpreter
meanwhile: in the loop's process that would be a fault that no real camera causes.
"""

import subprocess
import sys
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe

import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.moved_vehicle import start_python

EXPOSURE_S = 0.005
_SPREAD_S = 0.02  # the track covers this time before and after a stamp
_POSES = 9


def track_times_s() -> Float[np.ndarray, " poses"]:
    """The instants of a track's poses relative to the stamp, s."""
    return np.linspace(-_SPREAD_S, _SPREAD_S, _POSES)


class RenderingProcess:
    """A process that renders one set of images after the other. For one thread."""

    def __init__(self, rig: CameraRig, markers: MarkerMap, seed: int):
        """Start the process and wait until it has rendered a first set of images."""
        self._connection, theirs = Pipe()
        self._process = start_python(__name__, [theirs], {})
        self._connection.send((rig, markers, seed))
        self.render(np.tile([0.0, 0.0, 0.0], (_POSES, 1)))

    def render(
        self, poses: Float[np.ndarray, "poses 3"]
    ) -> list[UInt8[np.ndarray, "rows columns"]]:
        """Render the image of every camera.

        Args:
            poses: (x_m, y_m, psi_rad) at `track_times_s`, (9, 3).

        Raises:
            OSError: the process is gone.
        """
        try:
            self._connection.send(poses)
            images: list[np.ndarray] = self._connection.recv()
        except EOFError:
            raise OSError("the process that renders is gone") from None
        return images

    def close(self) -> None:
        """End the process. May be called any number of times."""
        self._connection.close()
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(2.0)


def _serve(connection: Connection) -> None:
    from jaxnav.sim.rendering import Renderer
    from jaxnav.sim.scene import Scene
    from jaxnav.sim.sensor import Sensor, Shutter

    rig, markers, seed = connection.recv()
    sensor = Sensor(psf_sigma_px=0.7, read_noise_grey=2.0, full_well_e=6000.0)
    renderer = Renderer(
        Scene.create(markers, seed=seed), rig, Shutter(exposure_s=EXPOSURE_S), sensor, threads=1
    )
    rng, times_s = np.random.default_rng(seed), track_times_s()
    while True:
        poses = connection.recv()

        def pose_at(at_s: np.ndarray, poses: np.ndarray = poses) -> np.ndarray:
            x_m, y_m, psi_rad = (np.interp(at_s, times_s, column) for column in poses.T)
            zero = np.zeros_like(x_m)
            half = psi_rad / 2
            return np.column_stack([np.cos(half), zero, zero, np.sin(half), x_m, y_m, zero])

        connection.send(renderer.render(pose_at, 0.0, rng))


if __name__ == "__main__":
    with suppress(EOFError, OSError):  # who asked has gone
        _serve(Connection(int(sys.argv[1])))
