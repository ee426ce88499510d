"""What is published of an outcome, by a connection that only keeps it."""

import dataclasses
import time
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import numpy as np
import pytest

from jaxnav.errors import Containment
from jaxnav.recordings.ros.estimates import base_hypotheses, base_pose, base_pose_covariance
from jaxnav.vehicles.ros import publisher as publishing
from jaxnav.vehicles.ros.publisher import FrameNames, Publisher
from tests.helpers.drives import make_outcome
from tests.worlds import paper_markers

BASE_X_M = -0.1


class Message:
    """A message of any type: fields come into being as they are looked at."""

    def __init__(self, **fields: Any):
        self.__dict__ |= fields | ({} if "markers" in fields else {"markers": []})

    def __getattr__(self, name: str) -> Any:
        setattr(self, name, Message())
        return self.__dict__[name]


class Kept:
    """A `Connection` whose publishers are the names of their topics."""

    def __init__(self) -> None:
        self.contained, self.sent = Containment(), []

    def publisher(self, kind: str, topic: str, latched: bool = False) -> str:
        return topic

    def publish(self, topic: str, message: Any) -> None:
        self.sent.append((topic, message))

    def stamp(self, now_ns: int) -> int:
        return now_ns

    def now_ns(self) -> int:
        return 0

    def forget(self, *topics: str) -> None:
        self.left = topics


@pytest.fixture
def outcome():
    """Of a car: as many numbers of the mean as rows of its covariance."""
    whole = make_outcome(3)
    belief = eqx.tree_at(lambda b: b.bank.mean, whole.belief, whole.belief.bank.mean[:, :6])
    spread = eqx.tree_at(lambda o: o.pose_covariance, whole.output, 0.01 * np.eye(3))
    return dataclasses.replace(whole, belief=belief, output=spread)


def published(monkeypatch, *outcomes, odom=None) -> tuple[Kept, dict[str, Any]]:
    monkeypatch.setattr(publishing, "message_type", lambda kind: Message)
    monkeypatch.setattr(publishing, "_PERIOD_S", 0.01)
    kept = Kept()
    publisher = Publisher(kept, FrameNames(), paper_markers(), odom, 0.5, BASE_X_M)
    for outcome in outcomes:
        publisher.publish(outcome)
    until_s = time.monotonic() + 10
    while "~/ghosts" not in dict(kept.sent) and time.monotonic() < until_s:
        time.sleep(0.005)
    publisher.close()
    assert kept.contained.summary() is None
    return kept, dict(kept.sent)


def place(pose: Message, rotation: str = "orientation", position: str = "position") -> list[float]:
    q, p = getattr(pose, rotation), getattr(pose, position)
    return [q.w, q.x, q.y, q.z, p.x, p.y, p.z]


def test_a_decided_pose_is_sent_as_transform_pose_and_odometry(monkeypatch, outcome):
    kept, told = published(monkeypatch, outcome)
    at_once = ("~/map", "/tf", "~/pose", "~/odometry")  # the rest comes from a thread, in between
    assert tuple(topic for topic, _ in kept.sent if topic in at_once) == at_once
    pose, covariance = base_pose_covariance(outcome, BASE_X_M)
    (transform,) = told["/tf"].transforms
    assert place(transform.transform, "rotation", "translation") == pytest.approx(pose.tolist())
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "base_link")
    assert transform.header.stamp == outcome.now_ns + 500_000_000
    assert place(told["~/pose"].pose.pose) == pytest.approx(pose.tolist())
    np.testing.assert_allclose(told["~/odometry"].pose.covariance, covariance.ravel())
    poses, _, weights = base_hypotheses(outcome, BASE_X_M)
    assert [place(one) for one in told["~/hypotheses"].poses] == [
        pytest.approx(one.tolist()) for one in poses
    ]
    assert len(told["~/ghosts"].markers) == 24 > len(weights) == 2
    (status,) = told["/diagnostics"].status
    values = {pair.key: pair.value for pair in status.values}
    assert status.message == outcome.health.name
    assert (values["decided"], values["restarts"]) == ("True", "2")
    assert set(kept.left) >= {"/tf", "~/pose", "~/odometry", "~/map"}


def test_an_undecided_pose_is_told_by_its_bank_alone(monkeypatch, outcome):
    undecided = eqx.tree_at(lambda o: o.decided, outcome.output, np.asarray(False))
    _, told = published(monkeypatch, dataclasses.replace(outcome, output=undecided))
    assert {"/tf", "~/pose", "~/odometry"}.isdisjoint(told)
    assert {"~/hypotheses", "~/ghosts", "/diagnostics"} <= told.keys()


def test_with_odometry_the_transform_is_that_of_its_frame(monkeypatch, outcome):
    unknown = SimpleNamespace(at=lambda now_ns: None)
    assert "/tf" not in published(monkeypatch, outcome, odom=unknown)[1]
    known = SimpleNamespace(at=lambda now_ns: base_pose(outcome, BASE_X_M))
    (transform,) = published(monkeypatch, outcome, odom=known)[1]["/tf"].transforms
    assert transform.child_frame_id == "odom"
    assert place(transform.transform, "rotation", "translation")[4:] == pytest.approx([0] * 3)
