"""Connect to ROS 2 with a node in a context of its own: the process's signals stay with the loop.

    connection = Connection("jaxnav_cameras", sim_time=False)
    connection.listen("sensor_msgs/msg/Image", "/front/image_raw", take)
    connection.run()
    ...
    connection.close()

Nothing that a callback raises ends the thread that calls back: see `Containment`.

Times in a program are those of `connection.now_ns`: the monotonic clock, or, with `ros_time`, that
of ROS, which is /clock with `sim_time`.
"""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from jaxnav.errors import BadInput, Containment, libraries_silenced
from jaxnav.recordings.ros import message_type
from jaxnav.vehicles.ros.source_clock import SourceClock, SteadyOffset

_QUEUE = 10
_LATCHED = 100  # messages of as many publishers
_WAIT_S = 0.05  # how long the thread sleeps where no message comes


def _executor_kind() -> Any:
    """The executor that waits in C++ and takes less time a message, where rclpy has it."""
    try:
        from rclpy.experimental import EventsExecutor

        return EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor


class Connection:
    """A node with topics and a thread that calls back. It must be closed.

    Attributes:
        node: rclpy's node.
        sim_time: whether ROS takes the time of /clock.
        ros_time: whether times are those of ROS, as they are stamped.
        contained: what callbacks have raised.
    """

    def __init__(
        self,
        name: str,
        sim_time: bool = False,
        ros_time: bool = False,
        make_node: Any = None,
        args: Any = None,
    ):
        """Enter ROS.

        Args:
            sim_time: whether time is that of /clock; `args` may say so too.
            ros_time: whether times are those of ROS; with `sim_time` they always are.
            make_node: called with name and context instead of `rclpy.create_node`.
            args: arguments of the command line for ROS.

        Raises:
            ImportError: ROS 2 is not there.
            OSError: ROS 2 can't start, or does not understand the arguments.
        """
        import rclpy
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions
        from rclpy.time import Time

        self._rclpy, self._Time = rclpy, Time
        self.contained = Containment()
        self._context = rclpy.Context()
        try:
            with libraries_silenced():  # the exception says the same
                rclpy.init(
                    args=args, context=self._context, signal_handler_options=SignalHandlerOptions.NO
                )
            self.node: Any = (make_node or rclpy.create_node)(name, context=self._context)
        except Exception as error:  # rclpy raises exceptions of its own
            raise OSError(f"ROS: {type(error).__name__}: {error}") from error
        if sim_time:
            self.node.set_parameters([Parameter("use_sim_time", value=True)])
        self.sim_time = bool(self.node.get_parameter("use_sim_time").value)
        self.ros_time = ros_time or self.sim_time
        self._offset = SteadyOffset(self._ros_ns)
        self._executor = _executor_kind()(context=self._context)
        self._executor.add_node(self.node)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def publisher(self, kind: str, topic: str, latched: bool = False) -> Any:
        """A publisher on a topic, for `publish`.

        Args:
            latched: later subscribers get the last message too.
        """
        from rclpy.qos import DurabilityPolicy, QoSProfile

        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        quality = QoSProfile(depth=1 if latched else _QUEUE, durability=durability)
        return self.node.create_publisher(message_type(kind), topic, quality)

    def listen(
        self,
        kind: str,
        topic: str,
        take: Callable[[Any], None],
        latched: bool = False,
        failed: Callable[[], None] = lambda: None,
    ) -> Any:
        """Pass every message of a topic to a function, in the thread of `run`.

        Args:
            latched: also those that were sent before.
            failed: called where `take` raises.

        Returns:
            The subscription, for `forget`.
        """
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

        quality = qos_profile_sensor_data  # best effort, which reliable publishers suit too
        if latched:
            quality = QoSProfile(depth=_LATCHED, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        contained = self.contained.wrap(topic, take, lambda problem, message: failed())
        return self.node.create_subscription(message_type(kind), topic, contained, quality)

    def every(self, period_s: float, name: str, function: Callable[[], None]) -> None:
        """Call a function again and again, in the thread of `run`."""
        contained = self.contained.wrap(name, function)
        self.node.create_timer(period_s, lambda: contained())  # or it would be passed the time

    def serve(
        self,
        kind: str,
        name: str,
        answer: Callable[..., Any],
        prepare: Callable[[Any], Any] | None = None,
    ) -> None:
        """Answer a service whose response has `success` and `message`, in the thread of `run`.

        Args:
            answer: returns the response to a request, once it is filled in; what it raises is said
                there.
            prepare: what takes seconds: it is called first, with the request, in a thread of its
                own, while others are called back; `answer` gets its result too.

        Raises:
            ImportError: its package is not there.
        """

        async def answered(request: Any, response: Any) -> Any:
            try:
                if prepare is None:
                    return answer(request, response)
                return answer(request, response, await self._result(partial(prepare, request)))
            except BadInput as bad:
                response.success, response.message = False, str(bad)
            except Exception as error:
                response.success, response.message = False, self.contained.note(name, error)
            return response

        self.node.create_service(message_type(kind), name, answered)

    def forget(self, *ends: Any) -> None:
        """Leave the topics of publishers and subscriptions."""
        for end in ends:
            self.node.destroy_publisher(end)
            self.node.destroy_subscription(end)

    @property
    def runs(self) -> bool:
        """Whether `run` was called."""
        return self._thread is not None

    def run(self) -> None:
        """Begin to call back, in a thread of its own."""
        self._thread = threading.Thread(target=self._run, name="ros", daemon=True)
        self._thread.start()

    def spin_some(self) -> None:
        """Call back what has come, before `run`."""
        self._executor.spin_once(timeout_sec=_WAIT_S)

    def publish(self, publisher: Any, message: Any) -> None:
        """Send a message.

        Raises:
            OSError: ROS refused it.
        """
        try:
            publisher.publish(message)
        except Exception as error:
            # rclpy raises exceptions of its own for a context that is gone.
            raise OSError(f"ROS: {type(error).__name__}: {error}") from error

    def now_ns(self) -> int:
        """The time, on the clock of the program."""
        return self._ros_ns() if self.ros_time else time.monotonic_ns()

    def stamp(self, now_ns: int) -> Any:
        """Convert a time of the program to a ROS stamp."""
        if self.ros_time:
            return self._Time(nanoseconds=max(now_ns, 0)).to_msg()
        age_ns = time.monotonic_ns() - now_ns
        return self._Time(nanoseconds=max(self._ros_ns() - age_ns, 0)).to_msg()

    def source_clock(self) -> SourceClock:
        """A clock that converts the stamps of one source to times of the program."""
        return SourceClock(None if self.ros_time else self._offset)

    def close(self) -> None:
        """Leave ROS. May be called any number of times."""
        if self._closing.is_set():
            return
        self._closing.set()
        if self._thread is not None:
            self._thread.join(1.0)
        self._executor.shutdown()
        self.node.destroy_node()
        self._rclpy.shutdown(context=self._context)

    def _ros_ns(self) -> int:
        return int(self.node.get_clock().now().nanoseconds)

    def _result(self, function: Callable[[], Any]) -> Any:
        """A future of what a function returns in a thread of its own."""
        from rclpy.task import Future

        future = Future(executor=self._executor)

        def work() -> None:
            try:
                result = function()
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(result)

        threading.Thread(target=work, name="ROS service", daemon=True).start()
        return future

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self.spin_some()
            except Exception as error:  # of rclpy itself
                if not self._context.ok():  # ROS was shut down: publishing says so
                    return
                self.contained.note("ROS", error)
                self._closing.wait(_WAIT_S)
