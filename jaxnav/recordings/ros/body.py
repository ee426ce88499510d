"""Localise a rig that moves freely while its frames and any odometry arrive.

Frames of one stamp are one observation. Observations are taken in the order of their stamps, and
wait for the odometry, so that who comes first changes nothing: what `jaxnav replay` makes of the
same frames is the same.
"""

import threading
import time
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from jaxnav.core.navigator import Navigator, Step
from jaxnav.core.pose.observation import Observation
from jaxnav.detection.observe import observe
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.frames import hide_nowhere
from jaxnav.drive.pilot import Outcome
from jaxnav.errors import Containment
from jaxnav.recordings.ros.odometry_track import SET_BACK_AFTER, SET_BACK_NS, GrowingTrack

MAX_DT_S = 1.0  # over a longer pause the motion is predicted for one second
_PATIENCE_S = 0.1  # an observation waits so long for its other cameras and the odometry
_NONE = Detections.concatenate([])


class BodyTracker:
    """The tracker of one rig, with a thread of its own.

    Attributes:
        late: frames older than the last observation, which are left out.
    """

    def __init__(
        self,
        navigator: Navigator,
        step: Step,
        cameras: int,
        publish: Callable[[Outcome], None],
        odometry: GrowingTrack | None = None,
        contained: Containment | None = None,
    ):
        """Args:
        step: compiled `navigator.step`.
        cameras: how many give frames.
        publish: gets the outcome of each observation, in the tracker's thread.
        odometry: of the rig, by other software, see `add_odometry`; None: there is none.
        contained: of what an observation raises, which is then left out.
        """
        self._navigator, self._step, self._publish = navigator, step, publish
        self._cameras, self._odometry = cameras, odometry
        self._state = navigator.init()
        self._last_ns: int | None = None
        self._sets: dict[int, tuple[float, dict[int, Detections]]] = {}  # by stamp
        self._came = threading.Condition()
        self._closed = False
        self.late = self._behind = 0
        self._handle = (contained or Containment()).wrap("the tracker", self._track)
        self._thread = threading.Thread(target=self._run, name="tracker", daemon=True)

    def warm_up(self) -> None:
        """Compile without changing the state."""
        self._step(self._state, self._observation({}, 0, 0))

    def start(self) -> None:
        """Begin to track."""
        self._thread.start()

    def add(self, camera: int, stamp_ns: int, detections: Detections) -> None:
        """Take a camera's frame, by the camera's index in the rig."""
        with self._came:
            if self._last_ns is not None and stamp_ns <= self._last_ns:
                self.late += 1
                behind = self._last_ns - stamp_ns >= SET_BACK_NS
                self._behind = self._behind + 1 if behind else 0
                if self._behind < SET_BACK_AFTER:
                    return
                self._last_ns = None
                self._sets.clear()
            self._behind = 0
            self._sets.setdefault(stamp_ns, (time.monotonic(), {}))[1][camera] = detections
            self._came.notify()

    def add_odometry(self, stamp_ns: int, T_odom_sensor: np.ndarray) -> None:
        """Take a pose (7,) of the odometry's body in its own frame."""
        assert self._odometry is not None
        with self._came:
            self._odometry.add(stamp_ns, T_odom_sensor)
            self._came.notify()

    def close(self) -> None:
        """End the thread."""
        with self._came:
            self._closed = True
            self._came.notify()
        if self._thread.ident is not None:
            self._thread.join(1.0)

    def _run(self) -> None:
        while (taken := self._next()) is not None:
            self._handle(*taken)

    def _track(self, stamp_ns: int, frames: dict[int, Detections]) -> None:
        before_ns = stamp_ns if self._last_ns is None else self._last_ns
        self._last_ns = stamp_ns
        obs = self._observation(frames, before_ns, stamp_ns)
        self._state, output = self._step(self._state, obs)
        belief = self._state.belief
        outcome = Outcome(
            stamp_ns, Health.OK, Fault(0), Reject(0), 0.0, 0.0, output, belief, None, stamp_ns,
            int(belief.restarts), "", origin_m=self._navigator.markers.origin_m,
        )  # fmt: skip
        self._publish(outcome)

    def _next(self) -> tuple[int, dict[int, Detections]] | None:
        """The next observation's stamp and frames; None: closed."""
        with self._came:
            while not self._closed:
                if self._sets:
                    stamp_ns = min(self._sets)
                    came_s, frames = self._sets[stamp_ns]
                    waits_s = came_s + _PATIENCE_S - time.monotonic()
                    known = self._odometry is None or self._odometry.reaches(stamp_ns)
                    if (known and len(frames) >= self._cameras) or waits_s <= 0:
                        del self._sets[stamp_ns]
                        return stamp_ns, frames
                    self._came.wait(waits_s)
                else:
                    self._came.wait()
            return None

    def _observation(
        self, frames: dict[int, Detections], before_ns: int, stamp_ns: int
    ) -> Observation:
        count = len(self._navigator.rig)
        lanes = observe([frames.get(c, _NONE) for c in range(count)], self._navigator.markers)
        hide_nowhere(lanes)
        dtype = np.asarray(self._navigator.corner_sigma_px).dtype
        dt_s, twist = max((stamp_ns - before_ns) / 1e9, 0.0), None
        if self._odometry is not None:
            with self._came:
                twist = self._odometry.twist(before_ns, stamp_ns)
        if twist is None or not np.isfinite(twist).all():
            dt_s = min(dt_s, MAX_DT_S)
        return Observation(
            jnp.asarray(lanes.corners_px, dtype),
            jnp.asarray(lanes.visible),
            dt_s=jnp.asarray(dt_s, dtype),
            twist=None if twist is None else jnp.asarray(twist, dtype),
        )
