"""Read TagSLAM's bags of detections, and its folders: such bags with results, and three YAML files.

cameras.yaml       intrinsics (Kalibr's keys), `tagtopic`, `rig_body`
*.bag[.bz2]        detections; `/tf` with every camera, marker and the rig; `odom_topic`
tagslam.yaml       sizes of the markers, and poses of the known ones; of the rig `odom_topic`, the
                   odometry of other software, and `T_body_odom`, the pose of its body on the rig;
                   of ours `odom_delay_s`, how long before their stamps its poses were taken, and
                   `odom_sigma: {scale: 0.03, turn_deg: 1}`, how far off it may be
camera_poses.yaml  poses of the cameras on the rig, where there is no /tf
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from jaxnav.core.models.conventions import APRILTAG_FIRST_CORNER
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection.types import Detections
from jaxnav.errors import BadInput
from jaxnav.files import kalibr, limits, poses
from jaxnav.files.markers import marker_map
from jaxnav.files.ranges import is_within, within
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import pose_entry, rig_of
from jaxnav.files.topics import OdometrySigma
from jaxnav.files.validation import Count, ForeignEntry, Number, Size, Text, Vector, at, validate
from jaxnav.recordings.other.bags import ReceivedMessage, is_ros1_bag, read_messages
from jaxnav.recordings.other.recording import Rows, Source, rows_of
from jaxnav.recordings.ros.camera_messages import TAGSLAM, detections
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY, stamp_ns
from jaxnav.recordings.ros.odometry_track import OdometryTrack

_FAMILY = "tag36h11"  # TagSLAM's default; its detections do not tell
_TF_TYPES = ("tf/msg/tfMessage", "tf2_msgs/msg/TFMessage")
_Poses = dict[int, np.ndarray]  # stamp in ns -> (7,) wxyz xyz
_Edges = dict[tuple[str, str], _Poses]  # (parent, child) -> the child's pose in the parent


@dataclass
class _Bag:
    """What a bag holds, by its topics."""

    kinds: dict[str, str] = field(default_factory=dict)  # of every topic
    frames: dict[str, list[tuple[int, Detections]]] = field(default_factory=dict)  # with stamps
    transforms: _Edges = field(default_factory=dict)
    odometry: dict[str, _Poses] = field(default_factory=dict)  # of its body in its own frame
    count: int = 0  # detections

    def take(self, received: ReceivedMessage) -> None:
        """Take a message."""
        topic, message = received.topic, received.message
        if received.kind == TAGSLAM:
            if len(message.apriltags) > limits.IN_VIEW:
                raise ValueError(f"a frame of more than {limits.IN_VIEW} detections")
            found = detections(TAGSLAM, message, APRILTAG_FIRST_CORNER, 1.0, {})
            self.count += len(found)
            if self.count > limits.DETECTIONS:
                raise ValueError(f"more than {limits.DETECTIONS} detections")
            self.frames.setdefault(topic, []).append((stamp_ns(message), found))
        elif received.kind == NAV_ODOMETRY:
            pose = message.pose.pose
            (row,) = _rigid([(pose.orientation, pose.position)], [f"a pose on {topic}"])
            self.odometry.setdefault(topic, {})[stamp_ns(message)] = row
        else:
            edges = [
                (one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/"))
                for one in message.transforms
            ]
            rows = _rigid(
                [(one.transform.rotation, one.transform.translation) for one in message.transforms],
                [f"the transform from {child} to {parent}" for parent, child in edges],
            )
            for one, edge, row in zip(message.transforms, edges, rows, strict=True):
                self.transforms.setdefault(edge, {})[stamp_ns(one)] = row


def _rigid(parts: list[tuple[Any, Any]], names: list[str]) -> np.ndarray:
    """Poses (N, 7) of rotations and positions, which are rigid and in the world."""
    poses = np.array([(q.w, q.x, q.y, q.z, p.x, p.y, p.z) for q, p in parts], float)
    poses = poses.reshape(-1, 7)
    off_unit = np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1)
    rigid = np.isfinite(poses).all(axis=1) & (off_unit <= 1e-3)
    near = is_within("position_m", poses[:, 4:]).all(axis=1)
    for index in np.flatnonzero(~(rigid & near))[:1]:
        problem = "leads out of the world" if rigid[index] else "is not rigid"
        raise ValueError(f"{names[index]} {problem}")
    return poses


def _read_bag(path: Path, odometry: str | None = None) -> _Bag:
    """Read a .bag or .bag.bz2.

    Args:
        odometry: the topic of odometry that is wanted; what others hold is not looked at.
    """
    bag = _Bag()

    def choose(kinds: Any) -> list[str]:
        bag.kinds = dict(kinds)
        return [
            topic
            for topic, kind in kinds.items()
            if kind in (TAGSLAM, *_TF_TYPES) or (kind == NAV_ODOMETRY and topic == odometry)
        ]

    read_messages(path, choose, bag.take)
    return bag


def _listed(recorded: Sequence[_Bag]) -> str:
    """The topics of some bags, for a message."""
    topics = sorted({f"{topic} ({kind})" for bag in recorded for topic, kind in bag.kinds.items()})
    return f"topics found: {', '.join(topics) or 'none'}"


def _rows(cameras: Sequence[list[tuple[int, Detections]]]) -> Rows:
    """One table of the detections by all cameras, which are in the order of the rig."""
    frames = [(ns, index, found) for index, seen in enumerate(cameras) for ns, found in seen]
    return rows_of(frames, [ns for ns, *_ in frames], tells_families=False)


def read_detection_bag(path: Path, rig: CameraRig, markers: Callable[[], MarkerMap]) -> Source:
    """Read a bag of detections, in which a rig's cameras are named like the topics.

    Raises:
        BadInput: the bag is broken, or a camera has no topic or several.
    """
    bag = _read_bag(path)

    def frames_of(camera: str) -> list[tuple[int, Detections]]:
        """Of the topic with the camera's name, or else with that name between two slashes."""
        topics = [topic for topic in bag.frames if topic.strip("/") == camera.strip("/")]
        topics = topics or [topic for topic in bag.frames if camera in topic.split("/")]
        if len(topics) == 1:
            return bag.frames[topics[0]]
        problem = f"no topic of {TAGSLAM} belongs to the camera {camera!r}"
        if topics:
            problem = f"several topics belong to the camera {camera!r}"
        raise BadInput(path, f"{problem}; {_listed([bag])}")

    return Source(path.name, _rows([frames_of(name) for name in rig.names]), rig, markers)


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

    def by_name(self) -> dict[str, _BodyEntry]:
        """The bodies by their names."""
        return {name: entry for body in self.bodies for name, entry in body.items()}


class _CameraPoseEntry(ForeignEntry):
    pose: _PoseEntry


def read_tagslam(path: Path, rig: CameraRig | None) -> Source:
    """Read a TagSLAM folder.

    Raises:
        BadInput: one line naming file and key.
    """
    files = [file for file in sorted(path.iterdir()) if is_ros1_bag(file)]
    names = {file.name for file in files}
    files = [file for file in files if file.name.removesuffix(".bz2") not in names - {file.name}]
    if not files:
        raise BadInput(path, "holds no .bag and no .bag.bz2")
    chain = kalibr.camchain(path / "cameras.yaml")
    body = next(iter(chain.values())).rig_body or "rig"
    file = path / "tagslam.yaml"
    settings = validate(TagSlamFile, read_mapping(file), file) if file.exists() else None
    moves = None if settings is None else settings.by_name().get(body)
    recorded = [_read_bag(file, None if moves is None else moves.odom_topic) for file in files]
    cameras = []
    for key, entry in chain.items():
        where = at(path / "cameras.yaml", key, "tagtopic")
        if entry.tagtopic is None:
            raise BadInput(where, "missing: on which topic are this camera's detections?")
        found = [bag.frames for bag in recorded]
        cameras.append(_only(found, entry.tagtopic, TAGSLAM, where, recorded))
    edges = {edge: stamped for bag in recorded for edge, stamped in bag.transforms.items()}
    rig = rig or _rig(path, chain, edges, body)
    if len(rig) != len(chain):
        problem = f"has {len(rig)} cameras, but {path / 'cameras.yaml'} has {len(chain)}"
        raise BadInput("--rig", problem)
    return Source(
        path.name,
        _rows(cameras),
        rig,
        lambda: _markers(file, settings, edges),
        lambda: _reference(edges, body),
        None if moves is None else _odometry(file, body, moves, recorded),
    )


def _only(
    by_topic: Sequence[dict[str, Any]], topic: str, kind: str, where: str, recorded: Sequence[_Bag]
) -> Any:
    """What the one bag that has a topic holds of it."""
    found = [held[topic] for held in by_topic if topic in held]
    if len(found) != 1:
        problem = f"{len(found) or 'no'} bags have {topic} of {kind}"
        raise BadInput(where, f"{problem}; {_listed(recorded)}")
    return found[0]


def _reference(edges: _Edges, body: str) -> _Poses | None:
    reference = {
        stamp: _canonical(pose)
        for (_, child), stamped in edges.items() if child == body
        for stamp, pose in stamped.items()
    }  # fmt: skip
    return reference or None


def _odometry(
    file: Path, body: str, entry: _BodyEntry, recorded: Sequence[_Bag]
) -> OdometryTrack | None:
    """The track of the rig's `odom_topic`; None where its entry names none."""
    if entry.odom_topic is None:
        return None
    where = at(file, f"bodies.{body}")
    if entry.T_body_odom is None:
        raise BadInput(f"{where}.T_body_odom", f"missing: where is the body of {entry.odom_topic}?")
    held = [bag.odometry for bag in recorded]
    track = _only(held, entry.odom_topic, NAV_ODOMETRY, f"{where}.odom_topic", recorded)
    stamps = sorted(track)
    poses_read = np.array([track[stamp] for stamp in stamps]).reshape(-1, 7)
    whole = OdometryTrack(
        np.array(stamps, np.int64), poses_read, entry.T_body_odom.pose(), entry.odom_sigma.sigma()
    )
    return whole.earlier_by(entry.odom_delay_s)


def _rig(path: Path, chain: dict[str, kalibr.KalibrCamera], edges: _Edges, body: str) -> CameraRig:
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
        cameras.append(entry.camera(key, pose_entry(poses.inverse(T_body_camera))))
    return rig_of(cameras)


def _markers(file: Path, settings: TagSlamFile | None, edges: _Edges) -> MarkerMap:
    """The map: poses from /tf, or else known ones of tagslam.yaml; sizes from tagslam.yaml."""
    settings = settings or validate(TagSlamFile, read_mapping(file), file)  # it is not there
    bodies = settings.by_name()
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


def _to_root(frame: str, parents: dict[str, tuple[str, _Poses]]) -> np.ndarray:
    T_root_frame = np.eye(4)
    seen = set()
    while frame in parents and frame not in seen:
        seen.add(frame)
        frame, stamped = parents[frame]
        T_root_frame = poses.matrix(_last(stamped)) @ T_root_frame
    return poses.pose_from_matrix(T_root_frame)


def _last(stamped: _Poses) -> np.ndarray:
    """The latest pose (7,), which TagSLAM published after its last optimisation."""
    return _canonical(stamped[max(stamped)])


def _canonical(pose: np.ndarray) -> np.ndarray:
    return poses.pose_from_matrix(poses.matrix(pose))
