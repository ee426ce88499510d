"""Reading and writing marker maps in YAML.

    markers:
      - id: 0
        family: tag36h11
        size_m: 0.172
        corners_world_m: [[...], [...], [...], [...]]   # TL TR BR BL, as its reader sees them

`T_world_marker` (4x4 or `{wxyz, xyz_m}`) may replace the corners: x right, y up, z towards the
reader. Wherever in the world a map is, its places are exact: see `jaxnav.core.models.origin`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator, model_validator

from jaxnav.core.models.markers import CORNER_SIGNS, FAMILY_SIZES, MarkerMap
from jaxnav.core.models.origin import Origin, opposite, origin_near, poses_in_world
from jaxnav.files import poses
from jaxnav.files.provenance import Calibrated, file_text
from jaxnav.files.reading import first_repeated
from jaxnav.files.rigs import pose_entry
from jaxnav.files.validation import Count, Entry, Place, Point, Pose, Size, Text, Wrong, read
from jaxnav.files.writing import atomic_write

# The most that a corner may be off the best square, in sides: a tape measure's error.
_MAX_CORNER_ERROR = 0.03


class MarkerSigma(Entry):
    """One standard deviation of a calibrated marker's place."""

    position_m: Point  # along the axes of the world
    rotation_deg: Point  # about the axes of the world


class MarkerEntry(Entry):
    """One marker of a map file, and of every other tool's file once it is read."""

    family: Text
    id: Count
    size_m: Size
    corners_world_m: Annotated[list[Place], Field(min_length=4, max_length=4)] | None = None
    T_world_marker: Pose | None = None
    sigma: MarkerSigma | None = None

    @model_validator(mode="after")
    def _agrees(self) -> "MarkerEntry":
        if self.family not in FAMILY_SIZES:
            problem = f"unknown {self.family!r}: expected one of {', '.join(FAMILY_SIZES)}"
            raise Wrong("family", problem)
        if self.id >= (count := FAMILY_SIZES[self.family]):
            raise Wrong("id", f"{self.family} has ids 0 to {count - 1}, got {self.id}")
        if (self.corners_world_m is None) == (self.T_world_marker is None):
            raise ValueError("needs exactly one of corners_world_m, T_world_marker")
        self.placed()
        return self

    def placed(self) -> "MarkerEntry":
        """The same marker, with `T_world_marker` for its place and no sigma."""
        T_world_marker = self.T_world_marker
        if self.corners_world_m is not None:
            try:
                pose = fit_square(np.array(self.corners_world_m), self.size_m)
            except ValueError as error:
                raise Wrong("corners_world_m", str(error)) from None
            T_world_marker = pose_entry(pose)
        return MarkerEntry.model_construct(
            id=self.id, family=self.family, size_m=self.size_m, T_world_marker=T_world_marker
        )


class MarkerFile(Entry):
    """A marker map file."""

    markers: Annotated[list[MarkerEntry], Field(min_length=1, max_length=4096)]
    calibrated: Calibrated | None = None

    @field_validator("markers")
    @classmethod
    def _each_once(cls, markers: list[MarkerEntry]) -> list[MarkerEntry]:
        if twice := first_repeated((marker.id, marker.family) for marker in markers):
            raise ValueError("marker {} of {} is in the map twice".format(*twice))
        return markers

    def map(self, origin_m: Origin | None = None) -> MarkerMap:
        """The map, in the process's precision; see `marker_map`."""
        return marker_map(
            np.stack([poses.pose_as_read(m.placed().T_world_marker) for m in self.markers]),
            [entry.size_m for entry in self.markers],
            [entry.id for entry in self.markers],
            [entry.family for entry in self.markers],
            origin_m,
        )


def load_markers(path: str | Path) -> MarkerMap:
    """Read a marker map.

    Raises:
        BadInput: one line naming file and key.
    """
    return read(path, MarkerFile).map()


def marker_map(
    Ts_world_marker: Float[np.ndarray, "M 7"],
    size_m: list[float],
    ids: list[int],
    families: list[str],
    origin_m: Origin | None = None,
) -> MarkerMap:
    """A map of M markers from plain values: poses (M, 7) wxyz_xyz, sizes, ids and families.

    Args:
        origin_m: the origin that the map counts from; by default one near the markers.
    """
    if origin_m is None:
        origin_m = origin_near(Ts_world_marker[:, 4:])
    counted = poses_in_world(Ts_world_marker, opposite(origin_m))
    return MarkerMap(
        Ts_world_marker=jaxlie.SE3(jnp.asarray(counted, float)),
        size_m=jnp.asarray(size_m, float),
        ids=tuple(int(marker_id) for marker_id in ids),
        families=tuple(families),
        origin_m=origin_m,
    )


def save_markers(
    path: str | Path,
    markers: MarkerMap,
    calibrated: Calibrated | None = None,
    sigmas: Sequence[MarkerSigma | None] | None = None,
) -> None:
    """Write a map; `load_markers` gives back the same numbers, bit for bit.

    Args:
        calibrated: the provenance of the figures.
        sigmas: one entry for each marker; None where its place was given.

    Raises:
        BadInput: the file can't be written.
    """
    data = marker_data(markers)
    for entry, sigma in zip(data["markers"], sigmas or (), strict=bool(sigmas)):
        if sigma is not None:
            entry["sigma"] = sigma.model_dump()
    atomic_write(path, file_text(data, calibrated))


def marker_data(markers: MarkerMap) -> dict[str, Any]:
    """The content of a map's file in plain values, all numbers bit for bit; see `MarkerFile`.

    Far from zero, places keep the digits that float64 has there: a nanometre at 10 000 km.
    """
    Ts_world_marker = poses_in_world(markers.Ts_world_marker.wxyz_xyz, markers.origin_m)
    each = zip(markers.ids, markers.families, markers.size_m, Ts_world_marker, strict=True)
    entries = [
        MarkerEntry.model_construct(
            id=marker_id,
            family=family,
            size_m=float(size_m),
            T_world_marker=pose_entry(np.asarray(T, float)),
        )
        for marker_id, family, size_m, T in each
    ]
    return _file_data(entries)


def _file_data(markers: Sequence[MarkerEntry]) -> dict[str, Any]:
    return {"markers": [marker.model_dump(exclude_none=True) for marker in markers]}


def markers_text(markers: Sequence[MarkerEntry]) -> str:
    """The markers as the text of a map file."""
    return file_text(_file_data(markers))


def markers_left_out(file: MarkerFile) -> list[str]:
    """The names of the entries of a map file that other formats don't hold."""
    left_out = ["calibrated"] if file.calibrated else []
    sigmas = sum(entry.sigma is not None for entry in file.markers)
    return left_out + ([f"sigma (of {sigmas} markers)"] if sigmas else [])


def fit_square(corners_m: Float[np.ndarray, "4 3"], size_m: float) -> Float[np.ndarray, " 7"]:
    """The pose (7,) wxyz_xyz of the square marker that fits measured corners (4, 3) best.

    Any square of the right side is a marker facing one way or the other; a bow tie, a rectangle
    or a folded square is none.

    Source: Kabsch (1976), "A solution for the best rotation to relate two sets of vectors".

    Raises:
        ValueError: the corners are not those of such a square.
    """
    model = size_m / 2 * CORNER_SIGNS
    center = corners_m.mean(axis=0)
    U, _, Vt = np.linalg.svd((corners_m - center).T @ model)
    mirrored = np.linalg.det(U @ Vt) < 0
    R = U @ np.diag([1, 1, -1 if mirrored else 1]) @ Vt
    errors_m = np.linalg.norm(center + model @ R.T - corners_m, axis=1)
    if errors_m.max() > _MAX_CORNER_ERROR * size_m:
        raise ValueError(
            f"TL TR BR BL must be a square with sides of {size_m:g} m: "
            f"corner [{errors_m.argmax()}] is {errors_m.max():.3g} m off"
        )
    return poses.pose_from_matrix(poses.transform(R, center))
