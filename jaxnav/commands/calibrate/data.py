"""Input data of `jaxnav calibrate rig`, `markers` and `check`: sightings and known markers."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.rig.views import RigViews
from jaxnav.core.models.markers import FAMILY_SIZES, MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.files import load_markers, load_rig
from jaxnav.recordings.other.recordings import RecordedSightings, read_sightings

_LEAST_SIGHTINGS = 3  # of a marker that is in no map
_APART_NS = 10**12  # between recordings
_MOST_LISTED = 12

MarkerKey = tuple[str, int]  # family, id


@dataclass(frozen=True)
class RigData:
    """Sightings of several recordings, with their rig and the known markers.

    Attributes:
        markers: the map, given or recorded, with markers that no camera saw; None without one.
        keys: (M,) family and id of each marker, in the order of `views`.
        known: T_world_marker (4, 4) of the known markers, by their index.
        parts: the sightings of each recording.
        anchored: whether a file or a recording knew a marker; if none did, one is the world.
    """

    rig: CameraRig
    views: RigViews
    markers: MarkerMap | None
    keys: tuple[MarkerKey, ...]
    known: dict[int, Float[np.ndarray, "4 4"]]
    parts: tuple[RecordedSightings, ...]
    anchored: bool


def read_rig_data(
    recordings: Sequence[Path],
    rig_file: Path | None,
    markers_file: Path | None,
    marker_size_m: float | None,
    family: str | None,
    only_known: bool = False,
) -> RigData:
    """Read all recordings and join their sightings, one recording after the other.

    Args:
        only_known: whether to leave out markers that are in no map.

    Raises:
        BadInput: names the file or the flag.
    """
    if family is not None and family not in FAMILY_SIZES:
        raise BadInput("--family", f"unknown {family!r}: expected one of {', '.join(FAMILY_SIZES)}")
    rig = None if rig_file is None else load_rig(rig_file)
    markers = None if markers_file is None else load_markers(markers_file)
    parts = [read_sightings(path, rig) for path in recordings]
    for part, path in zip(parts[1:], recordings[1:], strict=True):
        if part.rig.names != parts[0].rig.names:
            problem = f"its cameras are not those of {recordings[0]}: give one --rig for all"
            raise BadInput(path, problem)
    if markers is None:
        markers = next((part.markers for part in parts if part.markers is not None), None)
    if family is None:
        of_map = set() if markers is None else set(markers.families)
        family = of_map.pop() if len(of_map) == 1 else "tag36h11"
    seen = Counter(key for part in parts for key in _keys(part, family))
    keys = tuple(sorted(key for key in seen if _wanted(key, seen[key], markers, only_known)))
    if not keys:
        what = "a marker of the map" if only_known else "a marker often enough"
        raise BadInput(", ".join(map(str, recordings)), f"no camera saw {what}")
    index_of = {key: index for index, key in enumerate(keys)}
    known, sizes_m = _known(markers, keys, marker_size_m)
    anchored = bool(known)
    if not known:
        if markers is not None:
            ids = [marker_id for _, marker_id in keys]
            more = ", ..." if len(ids) > _MOST_LISTED else ""
            problem = (
                f"none of its markers ({', '.join(map(str, markers.ids))}) was seen; seen were "
                f"{', '.join(map(str, ids[:_MOST_LISTED]))}{more}"
            )
            raise BadInput(markers_file or "--markers", problem)
        known = {index_of[seen.most_common(1)[0][0]]: np.eye(4)}
    marker = np.array([index_of.get(key, -1) for part in parts for key in _keys(part, family)], int)
    used = marker >= 0
    firsts = np.cumsum([0, *(len(part.stamps_ns) for part in parts)])
    frame = np.concatenate([part.frame + n for part, n in zip(parts, firsts, strict=False)])
    views = RigViews(
        frame=frame[used],
        camera=np.concatenate([part.camera for part in parts])[used],
        marker=marker[used],
        corners_px=np.concatenate([part.corners_px for part in parts])[used],
        size_m=np.array(sizes_m),
        marker_ids=tuple(marker_id for _, marker_id in keys),
        stamps_ns=_one_after_the_other([part.stamps_ns for part in parts]),
    )
    return RigData(parts[0].rig, views, markers, keys, known, tuple(parts), anchored)


def _one_after_the_other(stamps_ns: Sequence[np.ndarray]) -> np.ndarray:
    """Stamps of all recordings, ns, increasing; those of the first recording do not change."""
    together = list(stamps_ns[:1])
    for stamps in stamps_ns[1:]:
        before = together[-1]
        together.append(stamps - stamps[:1] + before[-1:] + _APART_NS)
    return np.concatenate(together)


def _wanted(key: MarkerKey, count: int, markers: MarkerMap | None, only_known: bool) -> bool:
    if markers is not None and markers.index(key[1], key[0]) is not None:
        return True
    # An id that is seen more rarely is another pattern, taken for a marker.
    return count >= _LEAST_SIGHTINGS and not only_known


def _keys(part: RecordedSightings, family: str) -> list[MarkerKey]:
    families = part.families or (family,) * len(part.ids)
    return [(name, int(marker_id)) for name, marker_id in zip(families, part.ids, strict=True)]


def _known(
    markers: MarkerMap | None, keys: Sequence[MarkerKey], marker_size_m: float | None
) -> tuple[dict[int, np.ndarray], list[float]]:
    """T_world_marker (4, 4) of the known markers by index, and the sizes of all, m."""
    known, sizes_m = {}, []
    given = [] if markers is None else sorted({float(size) for size in markers.size_m})
    for index, (family, marker_id) in enumerate(keys):
        place = None if markers is None else markers.index(marker_id, family)
        if place is not None:
            assert markers is not None
            T = markers.Ts_world_marker.as_matrix()[place]
            known[index] = np.array(T, float)
            known[index][:3, 3] += markers.origin_m
            sizes_m.append(float(markers.size_m[place]))
        elif marker_size_m is not None or len(given) == 1:
            sizes_m.append(given[0] if marker_size_m is None else marker_size_m)
        else:
            problem = f"missing: how large is marker {marker_id} ({family}), which is in no map?"
            raise BadInput("--marker-size-m", problem)
    return known, sizes_m
