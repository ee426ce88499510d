"""`jaxnav ros`: a lifecycle node of ROS 2 around the loop that `jaxnav run` has.

configure    reads the files and compiles
activate     opens vehicle and cameras and begins to drive or to localise
deactivate   stops the vehicle and leaves the topics
"""

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from jaxnav.commands.drive.arguments import Ros
from jaxnav.commands.drive.ros_drive import OVER, PreparedDrive
from jaxnav.commands.drive.ros_setup import LOOK_S, Activity, Prepared, PreparedBody
from jaxnav.commands.process import configure_jax
from jaxnav.drive.signals import Signals
from jaxnav.errors import BadInput, visible
from jaxnav.files.ros import load_ros
from jaxnav.vehicles.ros.connection import Connection

_CLOCK_S = 10.0  # for the first message of /clock
EXIT_STOPPED = 1


def run(args: Ros, signals: Signals) -> int:
    """Run the node until a signal ends it or, unless it is managed, the drive ends.

    Raises:
        BadInput: a file, a topic or an option is wrong; where managed, the transition fails.
        Interrupted: a signal came.
    """
    configure_jax(float64=args.float64, threads=1)
    node = _Node(args, signals)
    try:
        if not args.managed:
            node.begin()
        node.connection.run()
        while args.managed or node.ended is None:
            signals.check()
            time.sleep(LOOK_S)
        return 0 if node.ended == OVER else EXIT_STOPPED
    finally:
        node.close()


class _Node:
    """The node: its transitions, services, and what it has made by them.

    Attributes:
        ended: why a drive ended by itself; None: none did.
    """

    def __init__(self, args: Ros, signals: Signals):
        self._args, self._signals = args, signals
        self._prepared: Prepared | None = None
        self._activity: Activity | None = None
        self._problem: BadInput | None = None
        self.ended: str | None = None
        try:
            self.connection = Connection(
                "jaxnav", make_node=partial(_lifecycle_node, self), args=list(args.ros_args)
            )
        except ImportError as error:
            problem = f"ROS 2 is missing ({error}): source its setup.bash, or see docs/guide/ros.md"
            raise BadInput("jaxnav ros", problem) from None
        except OSError as error:
            raise BadInput("--ros-args", str(error)) from None
        self._node: Any = self.connection.node
        given = self._node.declare_parameter("file", "").value
        self._file = str(args.file or given)
        self.connection.every(LOOK_S, "the end of the drive", self._look)
        for kind, name, *answers in (
            ("std_srvs/srv/Trigger", "~/reset", self._reset),
            ("jaxnav_msgs/srv/LoadMarkers", "~/load_markers", self._take_markers, self._load),
            ("jaxnav_msgs/srv/Save", "~/save", self._save),
        ):
            with suppress(ImportError):  # our messages were not built, or older ones
                self.connection.serve(kind, name, *answers)

    def begin(self) -> None:
        """Configure and activate.

        Raises:
            BadInput: what was wrong.
        """
        for step in (self._node.trigger_configure, self._node.trigger_activate):
            step()
            if self._problem is not None:
                raise self._problem

    def close(self) -> None:
        """Deactivate, and leave ROS."""
        self._cleanup()
        self.connection.close()

    def change_state(self, transition: str) -> bool:
        """Go through a transition; whether it went well. Called in the thread of ROS."""
        try:
            getattr(self, f"_{transition}")()
        except BadInput as error:
            self._problem = error
            if self._args.managed:
                self._say(f"{transition}: {error}")
            return False
        except Exception as error:  # ROS would print a trace of its own and go on
            self._problem = BadInput(transition, f"{type(error).__name__}: {error}")
            self._say(str(self._problem))
            return False
        self._problem = None
        return True

    def _configure(self) -> None:
        if not self._file:
            raise BadInput("file", "missing: the node's YAML file, as argument or as parameter")
        file = load_ros(self._file)
        kind = PreparedBody if file.vehicle is None else PreparedDrive
        prepared = kind(self._args, file, self.connection, self._signals, self._say)
        if self._prepared is not None:
            self._prepared.close()
        self._prepared = prepared

    def _activate(self) -> None:
        if self._prepared is None:
            raise BadInput("activate", "the node is not configured")
        if self.connection.sim_time:
            self._await_clock()
        self.ended = None
        self._activity = self._prepared.begin()

    def _deactivate(self) -> None:
        self._stop("deactivated")

    def _cleanup(self) -> None:
        self._stop("cleaned up")
        if self._prepared is not None:
            self._prepared.close()
        self._prepared = None

    _shutdown = _cleanup

    def _stop(self, reason: str) -> None:
        activity, self._activity = self._activity, None
        if activity is not None:
            activity.stop(reason)

    def _look(self) -> None:
        """Leave the active state where the activity has ended by itself."""
        if self._activity is not None and self._activity.ended is not None:
            self._end(self._activity.ended)

    def _end(self, why: str) -> None:
        self._say(f"ended: {why}")
        try:
            self._node.trigger_deactivate()
        finally:
            self.ended = why

    def _begin(self, prepared: Prepared) -> None:
        """Begin anew what was stopped; where that fails the node is not active any more."""
        try:
            self._activity = prepared.begin()
        except Exception as error:
            self._end(f"it could not begin anew: {error}")
            raise

    def _reset(self, request: Any, response: Any) -> Any:
        """Begin anew: nothing is known of the pose."""
        if self._activity is None or self._prepared is None:
            raise BadInput("reset", "the node is not active")
        self._stop("reset")
        self._begin(self._prepared)
        response.success, response.message = True, "reset"
        return response

    def _load(self, request: Any) -> tuple[Prepared, Prepared]:
        """Read another map and compile for it, beside the drive: a wrong one does not stop it."""
        prepared = self._prepared
        if prepared is None:
            raise BadInput("load_markers", "the node is not configured")
        return prepared, prepared.with_markers(str(request.path))

    def _take_markers(self, request: Any, response: Any, loaded: Any) -> Any:
        """Take the map that was loaded, and begin anew in it."""
        before, after = loaded
        if before is not self._prepared:
            raise BadInput("load_markers", "the node was configured anew meanwhile")
        active = self._activity is not None
        self._stop("another map")
        self._prepared = after
        after.show_map()
        if active:
            self._begin(after)
        response.success, response.message = True, "another map"
        return response

    def _save(self, request: Any, response: Any) -> Any:
        """Write what the drive has learnt into new files."""
        if self._activity is None:
            raise BadInput("save", "the node is not active")
        response.success, response.message = True, self._activity.save(str(request.folder))
        return response

    def _await_clock(self) -> None:
        until_s = time.monotonic() + _CLOCK_S
        while not self.connection.now_ns():
            # Once the node runs it has listened to /clock: nobody sends it.
            if self.connection.runs or time.monotonic() > until_s:
                raise BadInput("use_sim_time", "no message on /clock yet")
            self._signals.check()
            self.connection.spin_some()

    def _say(self, text: str) -> None:
        sys.stderr.write(f"jaxnav ros: {visible(text)}\n")


def _lifecycle_node(owner: _Node, name: str, context: Any) -> Any:
    """A lifecycle node whose transitions are those of its owner."""
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

    def step(transition: str) -> Callable[[Any, Any], Any]:
        def change_state(self: Any, state: Any) -> Any:
            good = owner.change_state(transition)
            return TransitionCallbackReturn.SUCCESS if good else TransitionCallbackReturn.FAILURE

        return change_state

    steps = ("configure", "activate", "deactivate", "cleanup", "shutdown")
    kind = type("JaxnavNode", (LifecycleNode,), {f"on_{one}": step(one) for one in steps})
    return kind(name, context=context)
