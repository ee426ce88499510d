"""Keep every ROS test on this machine, in a domain that no other process uses; without rclpy, no
file of this folder is collected: `make test-ros` runs them."""

import importlib.util
import os
import random
import socket
import tempfile
import warnings

import pytest

HAS_ROS = importlib.util.find_spec("rclpy") is not None
collect_ignore_glob = [] if HAS_ROS else ["test_*.py"]
_FIRST_PORT = 22119  # of a port for each domain: ROS's own tests claim theirs by the same ones
_DOMAINS = range(1, 101)  # those whose ports Linux hands to nobody else


def _claim_domain() -> tuple[int, socket.socket]:
    """A domain, and the socket that keeps others from it while it is open."""
    for domain in random.Random(os.getpid()).sample(_DOMAINS, len(_DOMAINS)):
        claim = socket.socket()
        try:
            claim.bind(("", _FIRST_PORT + domain))
        except OSError:
            claim.close()
            continue
        return domain, claim
    raise OSError("all ROS domains are taken")


def pytest_configure(config: pytest.Config) -> None:
    if not HAS_ROS:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # an old lark imports sre_parse
        importlib.import_module("rosidl_generator_py")
    domain, claim = _claim_domain()
    config.add_cleanup(claim.close)
    logs = tempfile.TemporaryDirectory(prefix="ros_log_")
    config.add_cleanup(logs.cleanup)
    os.environ |= {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(domain),
        "ROS_LOG_DIR": logs.name,
        # A killed process leaves its shared memory behind, which another may then read.
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }


def pytest_report_header() -> str | None:
    return None if HAS_ROS else "tests/real_ros: no rclpy here; make test-ros has it"
