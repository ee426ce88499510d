"""Rough poses of cameras and markers from sightings with two poses each, without a first guess.

Two markers that one camera sees together have the same relative pose in every frame; so have two
cameras that see the same marker, or markers whose relative poses are known by then. Every frame
proposes a relative pose for each branch of both sightings, and all frames vote. The true proposal
is the one that recurs, for mirrored poses disagree from frame to frame. Linked things form a group
that is then linked as one. No sighting is dropped: its branch is left open until others decide it.

After Ch'ng, Sogi, Latif, Reid, Chin (2020), "Resolving marker pose ambiguity by robust rotation
averaging with clique constraints", who ask the same consistency of rotations alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.calibrate.rig.views import RigViews, inverted, turn_rad

_NEAR_RAD = 0.03  # error of a corner predicted through a link at which its vote counts half
_DISTINCT_RAD = np.deg2rad(10)  # least turn between two different candidates
_ENOUGH = 400  # frames, if there are many
_VOTERS = 30  # frames that vote on a link
# Links are made in rounds: least votes beside the proposer's, and least part of all voters.
_ROUNDS = ((5.0, 0.5), (2.0, 0.3), (0.5, 0.0), (0.0, 0.0))


@dataclass
class Links:
    """Groups of cameras and groups of markers, with known relative poses within each group."""

    group_of_camera: Int[np.ndarray, " C"]
    Ts_group_camera: Float[np.ndarray, "C 4 4"]  # pose of each camera in the frame of its group
    group_of_marker: Int[np.ndarray, " M"]
    Ts_group_marker: Float[np.ndarray, "M 4 4"]  # pose of each marker in the frame of its group

    @staticmethod
    def none(cameras: int, markers: int) -> "Links":
        """Links with every camera and every marker in a group of its own."""
        Ts_camera, Ts_marker = (np.tile(np.eye(4), (count, 1, 1)) for count in (cameras, markers))
        return Links(np.arange(cameras), Ts_camera, np.arange(markers), Ts_marker)


@dataclass(frozen=True)
class Sights:
    """S sights, each of one group of markers by one group of cameras in one frame."""

    frame: Int[np.ndarray, " S"]  # the frame, and both groups
    cameras: Int[np.ndarray, " S"]
    markers: Int[np.ndarray, " S"]
    # the most likely pose and the next that differs from it
    Ts_cameras_markers: Float[np.ndarray, "S 2 4 4"]
    row: Int[np.ndarray, " S"]  # index of the sighting that appears largest


@dataclass(frozen=True)
class Linker:
    """Links cameras and markers by the sightings of a recording."""

    views: RigViews
    rays: Float[np.ndarray, "N 4 3"]  # unit rays through the corners, in the camera's frame
    Ts_camera_marker: Float[np.ndarray, "N 2 4 4"]  # both poses of every sighting

    @cached_property
    def _corners(self) -> Float[np.ndarray, "N 4 3"]:
        return self.views.corners_marker_m()

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
        """Link markers, then cameras, that enough frames agree on; true if any link is new."""
        if all(len(np.unique(of)) == 1 for of in (links.group_of_camera, links.group_of_marker)):
            return False
        any_new = False
        for cameras in (False, True):
            sights = self.sights(links)
            seer, seen = sights.cameras, sights.markers
            groups, Ts = links.group_of_marker, links.Ts_group_marker
            if cameras:
                seer, seen = seen, seer
                groups, Ts = links.group_of_camera, links.Ts_group_camera
            proposals = []
            for (a, b), x, y in _together(sights.frame, seer, seen):
                T_a_b, votes = self._vote(links, sights, x, y, inverse=cameras)
                voters = min(len(x), _VOTERS)
                if votes >= least and (voters == 1 or votes >= part * (voters - 1)):
                    proposals.append((votes, a, b, T_a_b))
            any_new |= _join(groups, Ts, proposals)
        return any_new

    def _vote(
        self, links: Links, sights: Sights, x: np.ndarray, y: np.ndarray, inverse: bool
    ) -> tuple[np.ndarray, float]:
        """T_x_y that most frames agree with, and the votes for it besides its proposer's.

        Args:
            x, y: rows of `sights` that belong together, of the two groups to be linked.
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
        proposer = np.repeat(np.arange(len(x)), 4)
        votes = agreement.sum(axis=0) - agreement[proposer, np.arange(4 * len(x))]
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
        size = count[group]
        i = np.repeat(np.arange(len(order)), size)
        j = first[group[i]] + np.arange(len(i)) - np.repeat(np.cumsum(size) - size, size)
        error = self._error_rad(links, order[j][:, None], Ts[order[i]])
        votes = np.zeros((len(order), 2))
        np.add.at(votes, i, _agreement(error))
        chosen = np.zeros((len(first), 2, 4, 4))
        rows = np.zeros(len(first), int)
        width_rad = np.linalg.norm(self.rays[:, 0] - self.rays[:, 2], axis=1)
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
            rows[g] = inside[np.argmax(width_rad[inside])]
        of = order[first]
        return Sights(views.frame[of], cameras[of], markers[of], chosen, rows)

    def _error_rad(self, links: Links, row: np.ndarray, Ts: np.ndarray) -> np.ndarray:
        """RMS angle between the corners of rows (...) and their predictions by poses (..., 4, 4) of
        a group of markers in a group of cameras."""
        views = self.views
        T_camera_cameras = inverted(links.Ts_group_camera)[views.camera[row]]
        T = T_camera_cameras @ Ts @ links.Ts_group_marker[views.marker[row]]
        points = self._corners[row] @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
        points /= np.linalg.norm(points, axis=-1, keepdims=True)
        squared = np.sum((points - self.rays[row]) ** 2, axis=-1)
        return np.asarray(np.sqrt(np.mean(squared, axis=-1)))


def _together(
    frame: np.ndarray, seer: np.ndarray, seen: np.ndarray
) -> Iterator[tuple[tuple[int, int], np.ndarray, np.ndarray]]:
    """Yield pairs that one seer sees in the same frames: (a, b), rows of a, rows of b; a < b."""
    sights: dict[tuple[int, int], list[int]] = {}
    for row in np.lexsort([seen, seer, frame]):
        sights.setdefault((int(frame[row]), int(seer[row])), []).append(int(row))
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for rows in sights.values():
        for x, y in combinations(rows, 2):
            pairs.setdefault((int(seen[x]), int(seen[y])), []).append((x, y))
    for pair, both in pairs.items():
        xs, ys = np.array(both).T
        yield pair, xs, ys


def _join(
    groups: np.ndarray, Ts: np.ndarray, proposals: list[tuple[float, int, int, np.ndarray]]
) -> bool:
    """Make the links in place, surest first, where no earlier one has; true if any is new.

    Args:
        groups: of every camera or marker, and their poses in it, `Ts`.
        proposals: votes, the groups a and b as they were, and T_a_b.
    """
    member = {int(group): index for index, group in enumerate(groups)}
    Ts_before = Ts.copy()

    def group_now(before: int) -> tuple[int, np.ndarray]:
        """The group that a group has become a part of, and its pose in that."""
        one = member[before]
        return int(groups[one]), Ts[one] @ inverted(Ts_before[one])

    any_new = False
    for _, a, b, T_a_b in sorted(proposals, key=lambda proposal: -proposal[0]):
        (group_a, T_a), (group_b, T_b) = group_now(a), group_now(b)
        if group_a != group_b:
            inside = groups == group_b
            Ts[inside] = T_a @ T_a_b @ inverted(T_b) @ Ts[inside]
            groups[inside] = group_a
            any_new = True
    return any_new


def _agreement(error_rad: np.ndarray) -> np.ndarray:
    return np.asarray(np.nan_to_num(1 / (1 + (error_rad / _NEAR_RAD) ** 2)))
