"""Reading recordings: a TagSLAM folder, a single ROS 1 bag with a rig and a marker map, an .npz."""

from pathlib import Path

from jaxnav.datasets import bags
from jaxnav.datasets.decoded import read_decoded
from jaxnav.datasets.recording import Recording, Reference, Rows, assemble
from jaxnav.datasets.tagslam import read_tagslam
from jaxnav.errors import BadInput
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig

__all__ = ["Recording", "Reference", "read_recording"]


def read_recording(
    path: str | Path, rig: CameraRig | None = None, markers: MarkerMap | None = None
) -> Recording:
    """Read a recording.

    Args:
        path: a TagSLAM folder, a .bag or .bag.bz2, or an .npz.
        rig: needed with a bag; replaces the recorded one otherwise.
        markers: the same for the marker map.

    Raises:
        BadInput: one line naming the file and what is wrong in it, or the flag that is missing.
    """
    path = Path(path)
    if path.is_dir():
        return read_tagslam(path, rig, markers)
    if not path.exists():
        raise BadInput(path, "there is no such file or folder")
    if path.suffix == ".npz":
        return read_decoded(path, rig, markers)
    if bags.is_bag(path):
        return _read_single_bag(path, rig, markers)
    raise BadInput(path, "is no recording: expected a folder, a .bag, a .bag.bz2 or an .npz")


def _read_single_bag(path: Path, rig: CameraRig | None, markers: MarkerMap | None) -> Recording:
    if rig is not None and markers is None:
        raise BadInput("--markers-file", f"missing: {path} does not say where its markers are")
    rows, rig = bag_rows(path, rig)
    assert markers is not None  # the rig is asked for first
    return assemble(path.name, rows, rig, markers)


def bag_rows(path: Path, rig: CameraRig | None) -> tuple[Rows, CameraRig]:
    """All detections of a single bag by the cameras of a rig, which are called like its topics.

    Raises:
        BadInput: one line naming the file, or the flag that is missing.
    """
    if rig is None:
        raise BadInput("--rig", f"missing: {path} alone does not say what its cameras are")
    bag = bags.read_bag(path)
    topics = [_topic_of(path, bag, name) for name in rig.names]
    return bags.rows_of_topics([bag.detections[t] for t in topics]), rig


def _topic_of(path: Path, bag: bags.Bag, camera: str) -> str:
    """The topic that is called like the camera, or has its name between two slashes."""
    candidates = [topic for topic in bag.detections if topic.strip("/") == camera.strip("/")]
    candidates = candidates or [topic for topic in bag.detections if camera in topic.split("/")]
    if len(candidates) == 1:
        return candidates[0]
    problem = f"no topic of {bags.DETECTIONS_TYPE} belongs to the camera {camera!r}"
    if candidates:
        problem = f"several topics belong to the camera {camera!r}"
    raise BadInput(path, f"{problem}; {bags.topics_found([bag])}")
