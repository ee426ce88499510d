"""Reading recordings: a TagSLAM folder, a single ROS 1 bag with a rig and a marker map, an .npz."""

from pathlib import Path
from typing import NoReturn

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.files.topics import TopicMap
from jaxnav.recordings.other import bags
from jaxnav.recordings.other.decoded import read_decoded
from jaxnav.recordings.other.recording import Recording, RecordingSource, Reference, assemble
from jaxnav.recordings.other.ros_rigs import read_ros_rig
from jaxnav.recordings.other.tagslam import read_tagslam
from jaxnav.recordings.ros.camera_messages import TAGSLAM

__all__ = ["Recording", "Reference", "read_recording"]


def read_recording(
    path: str | Path,
    rig: CameraRig | None = None,
    markers: MarkerMap | None = None,
    topics: TopicMap | None = None,
) -> Recording:
    """Read a recording.

    Args:
        path: a TagSLAM folder, a .bag or .bag.bz2, or an .npz.
        rig: needed with a bag; replaces the recorded one otherwise.
        markers: the same for the marker map.
        topics: which topic of a ROS bag, of ROS 1 or 2, is what; needs a rig and markers.

    Raises:
        BadInput: one line naming the file and what is wrong in it, or the flag that is missing.
    """
    path = Path(path)
    if topics is not None:
        if rig is None:
            _no_rig(path)
        return read_ros_rig(path, topics, rig, markers or _no_markers(path))
    if rig is not None and markers is None and bags.is_bag(path) and path.is_file():
        _no_markers(path)  # before all of it is read
    source = read_source(path, rig)
    return assemble(
        path,
        source.name,
        source.rows,
        source.rig,
        markers or source.markers(),
        source.reference(),
        source.odometry,
    )


def read_source(path: Path, rig: CameraRig | None, also: str = "") -> RecordingSource:
    """Read all detections of a recording, of markers in any map or none.

    Args:
        also: other formats that the caller reads, for the message about an unknown one.

    Raises:
        BadInput: one line naming the file, or the flag that is missing.
    """
    if path.is_dir():
        return read_tagslam(path, rig)
    if not path.exists():
        raise BadInput(path, "there is no such file or folder")
    if path.suffix == ".npz":
        return read_decoded(path, rig)
    if bags.is_bag(path):
        return _read_single_bag(path, rig)
    problem = f"is no recording: expected {also}a folder, a .bag, a .bag.bz2 or an .npz"
    raise BadInput(path, problem)


def _read_single_bag(path: Path, rig: CameraRig | None) -> RecordingSource:
    """Read a bag of detections, in which a rig's cameras are named like the topics."""
    if rig is None:
        _no_rig(path)
    bag = bags.read_bag(path)
    topics = [_topic_of(path, bag, name) for name in rig.names]
    rows = bags.rows_of_topics([bag.detections[t] for t in topics])
    return RecordingSource(path.name, rows, rig, lambda: _no_markers(path))


def _no_rig(path: Path) -> NoReturn:
    raise BadInput("--rig", f"missing: {path} alone does not say what its cameras are")


def _no_markers(path: Path) -> NoReturn:
    raise BadInput("--markers", f"missing: {path} does not say where its markers are")


def _topic_of(path: Path, bag: bags.Bag, camera: str) -> str:
    """The topic with the camera's name, or else with that name between two slashes."""
    candidates = [topic for topic in bag.detections if topic.strip("/") == camera.strip("/")]
    candidates = candidates or [topic for topic in bag.detections if camera in topic.split("/")]
    if len(candidates) == 1:
        return candidates[0]
    problem = f"no topic of {TAGSLAM} belongs to the camera {camera!r}"
    if candidates:
        problem = f"several topics belong to the camera {camera!r}"
    raise BadInput(path, f"{problem}; {bags.list_topics([bag])}")
