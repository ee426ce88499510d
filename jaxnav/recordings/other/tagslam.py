"""Reading of TagSLAM's folders: bags with detections and results, and three YAML files.

cameras.yaml       intrinsics (Kalibr's keys), `tagtopic`, `rig_body`
*.bag[.bz2]        detections; `/tf` with every camera, marker and the rig; `odom_topic`
tagslam.yaml       sizes of the markers, and poses of the known ones; of the rig `odom_topic`, the
                   odometry of other software, and `T_body_odom`, the pose of its body on the rig;
                   of ours `odom_delay_s`, how long before their stamps its poses were taken, and
                   `odom_sigma: {scale: 0.03, turn_deg: 1}`, how far off it may be
camera_poses.yaml  poses of the cameras on the rig, where there is no /tf
"""

import re
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.files import kalibr, poses
from jaxnav.files.figures import rig_from_figures
from jaxnav.files.markers import marker_map
from jaxnav.files.ranges import within
from jaxnav.files.reading import read_mapping
from jaxnav.files.topics import OdometrySigma
from jaxnav.files.validation import (
    Count,
    ForeignEntry,
    Number,
    Size,
    Text,
    Vector,
    at,
    validate,
)
from jaxnav.recordings.other import bags
from jaxnav.recordings.other.recording import RecordingSource
from jaxnav.recordings.ros.camera_messages import TAGSLAM
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.recordings.ros.odometry_track import OdometryTrack

_FAMILY = "tag36h11"  # TagSLAM's default; its detections do not tell


class _PoseEntry(ForeignEntry):
    position: Vector
    rotation: Vector

    def pose(self) -> np.ndarray:
        """The pose, (7,) wxyz xyz."""
        return poses.pose_from_rotation_vector(self.rotation.xyz(), self.position.xyz())


class _TagEntry(ForeignEntry):
    id: Count
    size: Size | None = None
    pose: _PoseEntry | None = None


class _BodyEntry(ForeignEntry):
    is_static: bool = True
    default_tag_size: Size | None = None
    pose: _PoseEntry | None = None
    tags: list[_TagEntry] = Field(default_factory=list)
    odom_topic: Text | None = None
    T_body_odom: _PoseEntry | None = None
    odom_delay_s: Annotated[Number, within("delay_s")] = 0.0
    odom_sigma: OdometrySigma = OdometrySigma()


class TagSlamFile(ForeignEntry):
    """The content of tagslam.yaml."""

    default_body: str | None = None
    bodies: Annotated[list[dict[str, _BodyEntry]], Field(min_length=1)]


class _CameraPoseEntry(ForeignEntry):
    pose: _PoseEntry


def read_tagslam(path: Path, rig: CameraRig | None) -> RecordingSource:
    """Read a TagSLAM folder.

    Raises:
        BadInput: one line naming file and key.
    """
    files = [file for file in sorted(path.iterdir()) if bags.is_bag(file)]
    names = {file.name for file in files}
    files = [file for file in files if file.name.removesuffix(".bz2") not in names - {file.name}]
    if not files:
        raise BadInput(path, "holds no .bag and no .bag.bz2")
    chain = kalibr.camchain(path / "cameras.yaml")
    body = next(iter(chain.values())).rig_body or "rig"
    moves = _body(path, body)
    topic = None if moves is None else moves.odom_topic
    recorded = [bags.read_bag(file, topic) for file in files]
    rows = bags.rows_of_topics(
        [_detections(path, key, entry, recorded) for key, entry in chain.items()]
    )
    edges = {edge: stamped for bag in recorded for edge, stamped in bag.transforms.items()}
    rig = rig or _rig(path, chain, edges, body)
    if len(rig) != len(chain):
        problem = f"has {len(rig)} cameras, but {path / 'cameras.yaml'} has {len(chain)}"
        raise BadInput("--rig", problem)
    return RecordingSource(
        path.name,
        rows,
        rig,
        lambda: _markers(path, edges),
        lambda: _reference(edges, body),
        None if moves is None else _odometry(path, body, moves, recorded),
    )


Edges = dict[tuple[str, str], dict[int, tuple[float, ...]]]


def _reference(edges: Edges, body: str) -> dict[int, np.ndarray] | None:
    reference = {
        stamp: _canonical(pose)
        for (_, child), stamped in edges.items() if child == body
        for stamp, pose in stamped.items()
    }  # fmt: skip
    return reference or None


def _detections(
    path: Path, key: str, entry: kalibr.KalibrCamera, recorded: list[bags.Bag]
) -> bags.TopicDetections:
    where = at(path / "cameras.yaml", key, "tagtopic")
    if entry.tagtopic is None:
        raise BadInput(where, "missing: on which topic are this camera's detections?")
    detections = [
        bag.detections[entry.tagtopic] for bag in recorded if entry.tagtopic in bag.detections
    ]
    if len(detections) != 1:
        problem = f"{len(detections) or 'no'} bags have {entry.tagtopic} of {TAGSLAM}"
        raise BadInput(where, f"{problem}; {bags.list_topics(recorded)}")
    return detections[0]


def _body(path: Path, body: str) -> _BodyEntry | None:
    """The entry of the rig in tagslam.yaml; None without one."""
    file = path / "tagslam.yaml"
    if not file.exists():
        return None
    return _by_name(validate(TagSlamFile, read_mapping(file), file)).get(body)


def _odometry(
    path: Path, body: str, entry: _BodyEntry, recorded: list[bags.Bag]
) -> OdometryTrack | None:
    """The track of the rig's `odom_topic`; None where its entry names none."""
    if entry.odom_topic is None:
        return None
    file = path / "tagslam.yaml"
    where = at(file, f"bodies.{body}")
    if entry.T_body_odom is None:
        raise BadInput(f"{where}.T_body_odom", f"missing: where is the body of {entry.odom_topic}?")
    tracks = [
        bag.odometry[entry.odom_topic] for bag in recorded if entry.odom_topic in bag.odometry
    ]
    if len(tracks) != 1:
        problem = f"{len(tracks) or 'no'} bags have {entry.odom_topic} of {NAV_ODOMETRY}"
        raise BadInput(f"{where}.odom_topic", f"{problem}; {bags.list_topics(recorded)}")
    (track,) = tracks
    stamps = sorted(track)
    poses_read = np.array([track[stamp] for stamp in stamps]).reshape(-1, 7)
    whole = OdometryTrack(
        np.array(stamps, np.int64), poses_read, entry.T_body_odom.pose(), entry.odom_sigma.sigma()
    )
    return whole.earlier_by(entry.odom_delay_s)


def _by_name(settings: TagSlamFile) -> dict[str, _BodyEntry]:
    return {name: entry for body in settings.bodies for name, entry in body.items()}


def _rig(path: Path, chain: dict[str, kalibr.KalibrCamera], edges: Edges, body: str) -> CameraRig:
    cameras = []
    file = path / "camera_poses.yaml"
    written = None
    for key, entry in chain.items():
        if (body, key) in edges:
            T_body_camera = _last(edges[body, key])
        else:
            written = read_mapping(file) if written is None else written
            if key not in written:
                raise BadInput(at(file, key), f"missing, and no /tf from {body} to {key} either")
            T_body_camera = validate(_CameraPoseEntry, written[key], file, key).pose.pose()
        cameras.append(entry.figures(key, poses.inverse(T_body_camera)))
    return rig_from_figures(cameras)


def _markers(path: Path, edges: Edges) -> MarkerMap:
    """The map: poses from /tf, or else known ones of tagslam.yaml; sizes from tagslam.yaml."""
    file = path / "tagslam.yaml"
    settings = validate(TagSlamFile, read_mapping(file), file)
    bodies = _by_name(settings)
    entry_of = {(name, tag.id): tag for name, body in bodies.items() for tag in body.tags}
    Ts_world_marker: dict[int, tuple[str, np.ndarray]] = {}
    parents = {child: (parent, stamped) for (parent, child), stamped in edges.items()}
    for parent, child in edges:
        number = child.removeprefix("tag_")
        if number != child and re.fullmatch("[0-9]{1,9}", number):
            Ts_world_marker[int(number)] = (parent, _to_root(child, parents))
    if not Ts_world_marker:
        for (name, tag_id), tag in entry_of.items():
            body = bodies[name]
            if tag.pose is not None and body.pose is not None and body.is_static:
                T_world_marker = poses.compose(body.pose.pose(), tag.pose.pose())
                Ts_world_marker[tag_id] = (name, T_world_marker)
    if not Ts_world_marker:
        problem = "has no static body with a tag of known pose, and no /tf has tags"
        raise BadInput(at(file, "bodies"), problem)
    ids = sorted(Ts_world_marker)
    sizes_m = []
    for tag_id in ids:
        name = Ts_world_marker[tag_id][0]
        tag_entry = entry_of.get((name, tag_id))
        holder = bodies.get(name) or bodies.get(settings.default_body or "")
        size_m = (tag_entry and tag_entry.size) or (holder and holder.default_tag_size)
        if not size_m:
            raise BadInput(
                at(file, f"bodies.{name}.default_tag_size"), f"missing, for tag {tag_id}"
            )
        sizes_m.append(size_m)
    stacked = np.stack([Ts_world_marker[tag_id][1] for tag_id in ids])
    return marker_map(stacked, sizes_m, ids, [_FAMILY] * len(ids))


def _to_root(
    frame: str, parents: dict[str, tuple[str, dict[int, tuple[float, ...]]]]
) -> np.ndarray:
    T_root_frame = np.eye(4)
    seen = set()
    while frame in parents and frame not in seen:
        seen.add(frame)
        frame, stamped = parents[frame]
        T_root_frame = poses.matrix(_last(stamped)) @ T_root_frame
    return poses.pose_from_matrix(T_root_frame)


def _last(stamped: dict[int, tuple[float, ...]]) -> np.ndarray:
    """The latest pose (7,), which TagSLAM published after its last optimisation."""
    return _canonical(stamped[max(stamped)])


def _canonical(pose: tuple[float, ...]) -> np.ndarray:
    return poses.pose_from_matrix(poses.matrix(np.array(pose)))
