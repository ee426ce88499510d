"""Transitions of the node, and bad input."""

import pytest

from jaxnav.recordings.ros import message_type
from jaxnav.vehicles.ros.connection import Connection
from tests.real_ros.processes import node, until
from tests.real_ros.test_node_drives import write_file

CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE = 1, 2, 3, 4
UNCONFIGURED, INACTIVE, ACTIVE = 1, 2, 3


class Manager:
    """Who brings a managed node from state to state."""

    def __init__(self) -> None:
        self.connection = Connection("manager")
        self.change = message_type("lifecycle_msgs/srv/ChangeState")
        self.get = message_type("lifecycle_msgs/srv/GetState")
        self._change, self._get = (
            self.connection.node.create_client(kind, f"/jaxnav/{name}")
            for kind, name in ((self.change, "change_state"), (self.get, "get_state"))
        )
        self.connection.run()
        assert self._change.wait_for_service(60.0)
        assert self._get.wait_for_service(60.0)

    def go(self, transition: int) -> bool:
        """Ask for a transition; whether it succeeded."""
        request = self.change.Request()
        request.transition.id = transition
        return self._ask(self._change, request, 240.0).success

    @property
    def state(self) -> int:
        """The node's state."""
        return self._ask(self._get, self.get.Request(), 30.0).current_state.id

    def _ask(self, client, request, timeout_s):
        answer = client.call_async(request)
        until(answer.done, timeout_s)
        return answer.result()


def test_a_managed_node_does_nothing_until_it_is_told(tmp_path):
    file = write_file(tmp_path, route=None)  # it localises alone: nobody is driven
    with node(tmp_path, str(file), "--managed") as program:
        manager = Manager()
        try:
            assert manager.state == UNCONFIGURED
            good = file.read_text()
            file.write_text(good.replace("/odom", "7"))
            assert not manager.go(CONFIGURE)
            assert manager.state == UNCONFIGURED
            program.until("node.yaml: odometry")
            file.write_text(good)
            assert manager.go(CONFIGURE), program.said
            assert manager.state == INACTIVE
            for _ in range(2):
                assert manager.go(ACTIVATE), program.said
                assert manager.state == ACTIVE
                assert manager.go(DEACTIVATE), program.said
                assert manager.state == INACTIVE
            assert manager.go(CLEANUP)
            assert manager.state == UNCONFIGURED
        finally:
            manager.connection.close()
        assert "Traceback" not in program.said


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"rig": "none.yaml"}, "node.yaml: rig: there is no file"),
        ({"odometry": None}, "node.yaml: a vehicle needs odometry"),
        ({"cameras": "{frnt: /front/detections}"}, "node.yaml: cameras.frnt: the rig has no such"),
        (
            {"camera_info": "{front: /nobody}"},
            "node.yaml: camera_info.front: no message on /nobody for 10 s",
        ),
        ({"selector": "best"}, "node.yaml: selector: unknown 'best'"),
        ({"vehicle": None}, "node.yaml: route needs a vehicle"),
        ({"wheels": "4"}, "node.yaml: wheels: "),
    ],
)
def test_bad_input_gets_one_line(tmp_path, changes, expected):
    with node(tmp_path, str(write_file(tmp_path, **changes))) as program:
        assert program.ends(120.0) == 2
        lines = program.said.splitlines()
        assert len(lines) == 1, program.said
        assert expected in lines[0]


def test_words_that_ros_does_not_know_get_one_line(tmp_path):
    words = ("--ros-args", "-p", "use_sim_time")
    with node(tmp_path, str(write_file(tmp_path)), *words) as program:
        assert program.ends(120.0) == 2
        assert program.said.startswith("jaxnav ros: --ros-args: ")
        assert len(program.said.splitlines()) == 1, program.said
