"""Read TagSLAM's bags of detections, and its folders: such bags with results, and three YAML files.

cameras.yaml       intrinsics (Kalibr's keys), `tagtopic`, `rig_body`
*.bag[.bz2]        detections; `/tf` with every camera, marker and the rig; `odom_topic`
tagslam.yaml       sizes of the markers, and poses of the known ones, also as boards; ids that
                   stand for others for a while (`tag_id_remap`) and detections that are left out
                   (`squash`, `ignore_tags`); of the rig `odom_topic`, the
                   odometry of other software, and `T_body_odom`, the pose of its body on the rig;
                   of ours `odom_delay_s`, how long before their stamps its poses were taken, and
                   `odom_sigma: {scale: 0.03, turn_deg: 1}`, how far off it may be
camera_poses.yaml  poses of the cameras on the rig, where there is no /tf

Markers on a body that moves are no landmarks, and left out of the map. Where all of them are on
one that moves, it is the world: the reference is the rig's pose on it.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

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
_NOWHERE = np.array([1.0, 0, 0, 0, 0, 0, 0])  # the pose that moves nothing
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


_Lines = Annotated[int, Field(strict=True, ge=1, le=100)]


class _BoardEntry(ForeignEntry):
    """Tags in rows, all alike, numbered row by row, with gaps as shares of their size."""

    tag_start_id: Count
    tag_size: Size
    tag_spacing: Annotated[Number, within("spacing")]
    tag_rows: _Lines
    tag_columns: _Lines
    pose: _PoseEntry | None = None  # of the body on the board

    def tags(self, staggered: bool) -> dict[int, "_Tag"]:
        """The tags by their ids. A staggered board has every second place, and its rows go down."""
        step_m = self.tag_size * (1 + self.tag_spacing)
        T_body_board = poses.inverse(_NOWHERE if self.pose is None else self.pose.pose())
        places = [
            (column * step_m, (-row if staggered else row) * step_m)
            for row in range(self.tag_rows)
            for column in range(row % 2 if staggered else 0, self.tag_columns, 1 + staggered)
        ]
        return {
            self.tag_start_id + index: _Tag(
                self.tag_size, poses.compose(T_body_board, np.array([1, 0, 0, 0, x_m, y_m, 0.0]))
            )
            for index, (x_m, y_m) in enumerate(places)
        }


class _Tag(NamedTuple):
    """What is written of a tag."""

    size_m: float | None
    T_body_tag: np.ndarray | None  # (7,)


class _BodyEntry(ForeignEntry):
    is_static: bool = True
    default_tag_size: Size | None = None
    pose: _PoseEntry | None = None
    tags: list[_TagEntry] = Field(default_factory=list)
    board: _BoardEntry | None = None
    staggered_board: _BoardEntry | None = None
    ignore_tags: list[Count] = Field(default_factory=list)
    odom_topic: Text | None = None
    T_body_odom: _PoseEntry | None = None
    odom_delay_s: Annotated[Number, within("delay_s")] = 0.0
    odom_sigma: OdometrySigma = OdometrySigma()

    @cached_property
    def by_id(self) -> dict[int, _Tag]:
        """The tags that are on it, by their ids."""
        boards = (self.board, False), (self.staggered_board, True)
        return {
            tag.id: _Tag(tag.size, None if tag.pose is None else tag.pose.pose())
            for tag in self.tags
        } | {
            tag_id: tag
            for board, staggered in boards if board is not None
            for tag_id, tag in board.tags(staggered).items()
        }  # fmt: skip


_Stamp = Annotated[Decimal, Field(ge=0, le=2**33)]  # s; a text keeps all of its digits
_STAMP_TOLERANCE_NS = 1000  # a float has 200


class _RemapEntry(ForeignEntry):
    remap_id: Count
    camera: str = ""  # every one
    start_time: _Stamp
    end_time: _Stamp


class _RemapsEntry(ForeignEntry):
    id: Count
    remaps: list[_RemapEntry]


class _SquashEntry(ForeignEntry):
    tags: list[Count]
    time: _Stamp = Decimal(0)  # 0: at all times, in the camera
    camera: str = ""


class TagSlamFile(ForeignEntry):
    """The content of tagslam.yaml."""

    default_body: str | None = None
    bodies: Annotated[list[dict[str, _BodyEntry]], Field(min_length=1)]
    tag_id_remap: list[_RemapsEntry] = Field(default_factory=list)
    squash: list[_SquashEntry] = Field(default_factory=list)

    def by_name(self) -> dict[str, _BodyEntry]:
        """The bodies by their names."""
        return {name: entry for body in self.bodies for name, entry in body.items()}

    def applied(self, rows: Rows, cameras: Sequence[str]) -> Rows:
        """Detections less those that the file leaves out, and under the ids that it gives them.

        Args:
            cameras: their names, in the order of the rig.
        """
        stamps_ns, camera = rows.stamps_ns, np.array(cameras)[rows.cameras]

        def during(begin_s: Decimal, end_s: Decimal) -> np.ndarray:
            begin_ns, end_ns = (int(stamp_s * 10**9) for stamp_s in (begin_s, end_s))
            after = stamps_ns >= begin_ns - _STAMP_TOLERANCE_NS
            return np.asarray(after & (stamps_ns <= end_ns + _STAMP_TOLERANCE_NS))

        ignored = [tag for body in self.by_name().values() for tag in body.ignore_tags]
        left_out = np.isin(rows.ids, ignored)
        for squash in self.squash:
            there = during(squash.time, squash.time) if squash.time else camera == squash.camera
            left_out |= there & np.isin(rows.ids, squash.tags)
        ids = rows.ids.copy()
        for known in self.tag_id_remap:
            for one in known.remaps:
                there = during(one.start_time, one.end_time) & (rows.ids == known.id)
                ids[there & ((camera == one.camera) | (one.camera == ""))] = one.remap_id
        kept = ~left_out
        return replace(
            rows,
            stamps_ns=stamps_ns[kept],
            cameras=rows.cameras[kept],
            ids=ids[kept],
            corners_px=rows.corners_px[kept],
        )


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
    rows = _rows(cameras)
    rows = rows if settings is None else settings.applied(rows, list(chain))
    rig = rig or _rig(path, chain, edges, body)
    if len(rig) != len(chain):
        problem = f"has {len(rig)} cameras, but {path / 'cameras.yaml'} has {len(chain)}"
        raise BadInput("--rig", problem)
    return Source(
        path.name,
        rows,
        rig,
        lambda: _markers(file, settings, edges, body),
        lambda: _reference(edges, body, _world(file, settings, edges, body)),
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


def _reference(edges: _Edges, body: str, world: str | None) -> _Poses | None:
    """The poses of the rig in the world, which may be a body that moves."""

    def of(name: str) -> _Poses:
        return {
            stamp: _canonical(pose)
            for (_, child), stamped in edges.items() if child == name
            for stamp, pose in stamped.items()
        }  # fmt: skip

    reference = of(body)
    if world is not None:
        moves, last = of(world), max(reference, default=0)
        reference = {
            stamp: poses.compose(poses.inverse(pose), reference.get(stamp, reference[last]))
            for stamp, pose in moves.items() if stamp in reference or len(reference) == 1
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


def _tagged(edges: _Edges) -> dict[int, tuple[str, str]]:
    """The body that each marker of /tf is on, and the marker's frame, by the marker's id."""
    holders = {}
    for parent, child in edges:
        number = child.removeprefix("tag_")
        if number != child and re.fullmatch("[0-9]{1,9}", number):
            holders[int(number)] = (parent, child)
    return holders


def _world(file: Path, settings: TagSlamFile | None, edges: _Edges, rig_body: str) -> str | None:
    """The body that all known markers are on, where that one moves; None: some of them stand."""
    bodies = {} if settings is None else settings.by_name()
    holders = {holder for holder, _ in _tagged(edges).values()} or {
        name
        for name, body in bodies.items()
        if any(tag.T_body_tag is not None for tag in body.by_id.values())
    }
    moving = {name for name in holders if name in bodies and not bodies[name].is_static}
    if holders - moving:
        return None
    moving -= {rig_body}
    if len(moving) > 1:
        several = ", ".join(sorted(moving))
        raise BadInput(at(file, "bodies"), f"all tags are on several bodies that move: {several}")
    return next(iter(moving), None)


def _markers(file: Path, settings: TagSlamFile | None, edges: _Edges, rig_body: str) -> MarkerMap:
    """The map: poses from /tf, or else known ones of tagslam.yaml; sizes from tagslam.yaml."""
    settings = settings or validate(TagSlamFile, read_mapping(file), file)  # it is not there
    bodies = settings.by_name()
    world = _world(file, settings, edges, rig_body)
    stands = {name for name, body in bodies.items() if body.is_static or name == world}
    Ts_world_marker: dict[int, tuple[str, np.ndarray]] = {}
    parents = {child: (parent, stamped) for (parent, child), stamped in edges.items()}
    tagged = _tagged(edges)
    for tag_id, (parent, frame) in tagged.items():
        if parent in stands or parent not in bodies:
            Ts_world_marker[tag_id] = (parent, _to_root(frame, parents, world))
    for name in stands if not tagged else ():
        body = bodies[name]
        for tag_id, tag in body.by_id.items():
            if tag.T_body_tag is not None and (name == world or body.pose is not None):
                T_world_body = body.pose.pose() if body.pose is not None else _NOWHERE
                T_world_marker = poses.compose(T_world_body, tag.T_body_tag)
                Ts_world_marker[tag_id] = (name, T_world_marker)
    if not Ts_world_marker:
        problem = "has no static body with a tag of known pose, and no /tf has tags"
        raise BadInput(at(file, "bodies"), problem)
    ids = sorted(Ts_world_marker)
    sizes_m = []
    for tag_id in ids:
        name = Ts_world_marker[tag_id][0]
        holder = bodies.get(name) or bodies.get(settings.default_body or "")
        own = holder and holder.by_id.get(tag_id)
        size_m = (own and own.size_m) or (holder and holder.default_tag_size)
        if not size_m:
            raise BadInput(
                at(file, f"bodies.{name}.default_tag_size"), f"missing, for tag {tag_id}"
            )
        sizes_m.append(size_m)
    stacked = np.stack([Ts_world_marker[tag_id][1] for tag_id in ids])
    return marker_map(stacked, sizes_m, ids, [_FAMILY] * len(ids))


def _to_root(frame: str, parents: dict[str, tuple[str, _Poses]], root: str | None) -> np.ndarray:
    T_root_frame = np.eye(4)
    seen: set[str] = set()
    while frame in parents and frame not in {*seen, root}:
        seen.add(frame)
        frame, stamped = parents[frame]
        T_root_frame = poses.matrix(_last(stamped)) @ T_root_frame
    return poses.pose_from_matrix(T_root_frame)


def _last(stamped: _Poses) -> np.ndarray:
    """The latest pose (7,), which TagSLAM published after its last optimisation."""
    return _canonical(stamped[max(stamped)])


def _canonical(pose: np.ndarray) -> np.ndarray:
    return poses.pose_from_matrix(poses.matrix(pose))
