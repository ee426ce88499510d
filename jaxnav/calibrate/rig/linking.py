"""Rough poses of cameras and markers from sightings with two poses each, without a first guess.

Two markers that one camera sees together have the same relative pose in every frame; so have two
cameras that see the same marker, or markers whose relative poses are known by then. Every frame
proposes a relative pose for each branch of both sightings, and all frames vote. The true proposal
is the one that recurs, for mirrored poses disagree from frame to frame. Linked things form a group
that is then linked as one. No sighting is dropped: its branch is left open until others decide it.

After Ch'ng, Sogi, Latif, Reid, Chin (2020), "Resolving marker pose ambiguity by robust rotation
averaging with clique constraints", who ask the same consistency of rotations alone.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.calibrate.rig.pose_arrays import inverted, turn_rad
from jaxnav.calibrate.rig.views import RigViews

_NEAR_RAD = 0.03  # error of a corner predicted through a link at which its vote counts half
_DISTINCT_RAD = np.deg2rad(10)  # least turn between two different candidates
_ENOUGH = 400  # frames, if there are many
_VOTERS = 30  # frames that vote on a link
# Links are made in rounds: least votes beside the proposer's, and least part of all voters.
_ROUNDS = ((5.0, 0.5), (2.0, 0.3), (0.5, 0.0), (0.0, 0.0))

# Votes, number of frames that see both, the two groups a and b, and T_a_b.
Proposal = tuple[float, int, int, int, Float[np.ndarray, "4 4"]]


@dataclass
class Links:
    """Groups of cameras and groups of markers, with known relative poses within each group.

    Attributes:
        group_of_camera: (C,), group_of_marker: (M,): the group of each.
        Ts_group_camera: (C, 4, 4), pose of each camera in the frame of its group.
        Ts_group_marker: (M, 4, 4), pose of each marker in the frame of its group.
    """

    group_of_camera: Int[np.ndarray, " C"]
    Ts_group_camera: Float[np.ndarray, "C 4 4"]
    group_of_marker: Int[np.ndarray, " M"]
    Ts_group_marker: Float[np.ndarray, "M 4 4"]

    @staticmethod
    def none(cameras: int, markers: int) -> "Links":
        """Links with every camera and every marker in a group of its own."""
        return Links(
            np.arange(cameras),
            np.tile(np.eye(4), (cameras, 1, 1)),
            np.arange(markers),
            np.tile(np.eye(4), (markers, 1, 1)),
        )

    def join_cameras(self, a: int, b: int, T_a_b: Float[np.ndarray, "4 4"]) -> None:
        """Merge the group b of cameras into the group a."""
        _merge(self.group_of_camera, self.Ts_group_camera, a, b, T_a_b)

    def join_markers(self, a: int, b: int, T_a_b: Float[np.ndarray, "4 4"]) -> None:
        """Merge the group b of markers into the group a."""
        _merge(self.group_of_marker, self.Ts_group_marker, a, b, T_a_b)


def _merge(groups: np.ndarray, Ts: np.ndarray, a: int, b: int, T_a_b: np.ndarray) -> None:
    inside = groups == b
    Ts[inside] = T_a_b @ Ts[inside]
    groups[inside] = a


@dataclass(frozen=True)
class Sights:
    """S sights, each of one group of markers by one group of cameras in one frame.

    Attributes:
        frame, cameras, markers: (S,) the frame and both groups.
        Ts_cameras_markers: (S, 2, 4, 4), the most likely pose and the next that differs from it.
        row: (S,) index of the sighting that appears largest.
    """

    frame: Int[np.ndarray, " S"]
    cameras: Int[np.ndarray, " S"]
    markers: Int[np.ndarray, " S"]
    Ts_cameras_markers: Float[np.ndarray, "S 2 4 4"]
    row: Int[np.ndarray, " S"]


class Linker:
    """Links cameras and markers by the sightings of a recording."""

    def __init__(
        self,
        views: RigViews,
        rays: Float[np.ndarray, "N 4 3"],
        Ts_camera_marker: Float[np.ndarray, "N 2 4 4"],
    ):
        """Args:
        rays: (N, 4, 3), unit rays through the corners, in the camera's frame.
        Ts_camera_marker: (N, 2, 4, 4), both poses of every sighting.
        """
        self.views, self.rays = views, rays
        self.Ts_camera_marker = Ts_camera_marker
        self.corners = views.corners_marker_m()
        self.width_rad = np.linalg.norm(rays[:, 0] - rays[:, 2], axis=1)

    def only(self, kept: Bool[np.ndarray, " N"]) -> "Linker":
        """The linker of these rows alone."""
        return Linker(self.views.only(kept), self.rays[kept], self.Ts_camera_marker[kept])

    def link(self, links: Links) -> None:
        """Make all links that the recording supports, first from a part of the frames if many."""
        frames = self.views.frames
        if frames > 2 * _ENOUGH:
            some = self.only(self.views.frame % (frames // _ENOUGH) == 0)
            while some._link_all(links, *_ROUNDS[0]):
                pass
        for least, part in _ROUNDS:
            while self._link_all(links, least, part):
                pass

    def _link_all(self, links: Links, least: float, part: float) -> bool:
        def alone(groups: np.ndarray) -> bool:
            return len(np.unique(groups)) == 1

        if alone(links.group_of_camera) and alone(links.group_of_marker):
            return False
        markers = self._link_markers(links, least, part)
        return self._link_cameras(links, least, part) or markers

    def _link_markers(self, links: Links, least: float, part: float) -> bool:
        sights = self.sights(links)
        proposals = []
        for (a, b), x, y in _together(sights.frame, sights.cameras, sights.markers):
            T, votes = self._vote(links, sights, x, y, inverse=False)
            proposals.append((votes, len(x), a, b, T))
        return _join(proposals, least, part, links.join_markers)

    def _link_cameras(self, links: Links, least: float, part: float) -> bool:
        sights = self.sights(links)
        voted: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
        # Each group of markers that both cameras saw votes on its own.
        for (a, b), x, y in _together(sights.frame, sights.markers, sights.cameras):
            voted.setdefault((a, b), []).append((x, y))
        proposals = []
        for (a, b), parts in voted.items():
            x, y = (np.concatenate(side) for side in zip(*parts, strict=True))
            T, votes = self._vote(links, sights, x, y, inverse=True)
            proposals.append((votes, len(x), a, b, T))
        return _join(proposals, least, part, links.join_cameras)

    def _vote(
        self, links: Links, sights: Sights, x: np.ndarray, y: np.ndarray, inverse: bool
    ) -> tuple[np.ndarray, float]:
        """T_x_y that most frames agree with, and the votes for it besides its proposer's.

        Args:
            x, y: (n,) corresponding rows of `sights` of the two groups to be linked.
            inverse: true if the groups are cameras, false if they are markers.
        """
        pick = np.unique(np.linspace(0, len(x) - 1, min(len(x), _VOTERS)).astype(int))
        x, y = x[pick], y[pick]
        Ts_x, Ts_y = sights.Ts_cameras_markers[x], sights.Ts_cameras_markers[y]
        if inverse:
            Ts_x, Ts_y = inverted(Ts_x), inverted(Ts_y)
        proposed = (inverted(Ts_x)[:, :, None] @ Ts_y[:, None]).reshape(-1, 4, 4)
        predicted = Ts_x[:, :, None] @ proposed  # (n, 2, 4 n, 4, 4)
        if inverse:
            predicted = inverted(predicted)
        error = self._error_rad(links, sights.row[y][:, None, None], predicted).min(axis=1)
        agreement = _agreement(error)
        # A proposer's vote for itself doesn't count.
        votes = (
            agreement.sum(axis=0)
            - agreement[np.repeat(np.arange(len(x)), 4), np.arange(4 * len(x))]
        )
        best = int(np.argmax(votes))
        return proposed[best], float(votes[best])

    def sights(self, links: Links) -> Sights:
        """All sightings gathered by groups, each at the branch that explains most of its group."""
        views = self.views
        cameras, markers = links.group_of_camera[views.camera], links.group_of_marker[views.marker]
        keys = np.stack([views.frame, cameras, markers], axis=1)
        order = np.lexsort(keys.T[::-1])
        first = np.flatnonzero(np.any(np.diff(keys[order], axis=0, prepend=-1), axis=1))
        group = np.cumsum(np.isin(np.arange(len(order)), first)) - 1
        Ts = (
            links.Ts_group_camera[views.camera][:, None]
            @ self.Ts_camera_marker
            @ inverted(links.Ts_group_marker[views.marker])[:, None]
        )
        # Every candidate of a group against every sighting of it.
        count = np.bincount(group)
        i = np.repeat(np.arange(len(order)), count[group])
        j = (
            first[group[i]]
            + np.arange(len(i))
            - np.repeat(np.cumsum(count[group]) - count[group], count[group])
        )
        error = self._error_rad(links, order[j][:, None], Ts[order[i]])
        votes = np.zeros((len(order), 2))
        np.add.at(votes, i, _agreement(error))
        chosen = np.zeros((len(first), 2, 4, 4))
        rows = np.zeros(len(first), int)
        for g, start in enumerate(first):
            inside = order[start : start + count[g]]
            candidates, score = (
                Ts[inside].reshape(-1, 4, 4),
                votes[start : start + count[g]].ravel(),
            )
            best = int(np.argmax(np.nan_to_num(score, nan=-1)))
            other = turn_rad(candidates[best], candidates) > _DISTINCT_RAD
            second = int(np.argmax(np.where(other, score, -1))) if other.any() else best
            chosen[g] = candidates[best], candidates[second]
            rows[g] = inside[np.argmax(self.width_rad[inside])]
        of = order[first]
        return Sights(views.frame[of], cameras[of], markers[of], chosen, rows)

    def _error_rad(self, links: Links, row: np.ndarray, Ts: np.ndarray) -> np.ndarray:
        """RMS angle between the corners of rows (...) and their predictions by poses (..., 4, 4) of
        a group of markers in a group of cameras."""
        views = self.views
        T_camera_cameras = inverted(links.Ts_group_camera)[views.camera[row]]
        T = T_camera_cameras @ Ts @ links.Ts_group_marker[views.marker[row]]
        points = self.corners[row] @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
        points /= np.linalg.norm(points, axis=-1, keepdims=True)
        squared = np.sum((points - self.rays[row]) ** 2, axis=-1)
        return np.asarray(np.sqrt(np.mean(squared, axis=-1)))


def _together(
    frame: np.ndarray, seer: np.ndarray, seen: np.ndarray
) -> Iterator[tuple[tuple[int, int], np.ndarray, np.ndarray]]:
    """Yield pairs that one seer sees in the same frames: (a, b), rows of a, rows of b; a < b."""
    order = np.lexsort([seen, seer, frame])
    pairs: dict[tuple[int, int], tuple[list[int], list[int]]] = {}
    starts = np.flatnonzero(
        np.any(np.diff(np.stack([frame, seer])[:, order], axis=1, prepend=-1), axis=0)
    )
    for start, end in zip(starts, [*starts[1:], len(order)], strict=True):
        rows = order[start:end]
        for index, x in enumerate(rows):
            for y in rows[index + 1 :]:
                xs, ys = pairs.setdefault((int(seen[x]), int(seen[y])), ([], []))
                xs.append(int(x))
                ys.append(int(y))
    for pair, (xs, ys) in pairs.items():
        yield pair, np.array(xs), np.array(ys)


def _join(
    proposals: list[Proposal],
    least: float,
    part: float,
    join: Callable[[int, int, np.ndarray], None],
) -> bool:
    """Make the links that enough frames agree with, surest first; true if any link is new."""
    joined_to: dict[int, int] = {}
    T_root: dict[int, np.ndarray] = {}

    def root(x: int) -> tuple[int, np.ndarray]:
        T = np.eye(4)
        while x in joined_to:
            T = T_root[x] @ T
            x = joined_to[x]
        return x, T

    any_new = False
    for votes, frames, a, b, T_a_b in sorted(proposals, key=lambda it: -it[0]):
        voters = min(frames, _VOTERS)
        if votes < least or (voters > 1 and votes < part * (voters - 1)):
            continue
        (root_a, T_a), (root_b, T_b) = root(a), root(b)
        if root_a == root_b:
            continue
        T = T_a @ T_a_b @ inverted(T_b)
        join(root_a, root_b, T)
        joined_to[root_b], T_root[root_b] = root_a, T
        any_new = True
    return any_new


def _agreement(error_rad: np.ndarray) -> np.ndarray:
    return np.asarray(np.nan_to_num(1 / (1 + (error_rad / _NEAR_RAD) ** 2)))
