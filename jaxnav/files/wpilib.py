"""Reading and writing WPILib's field layout in JSON: AprilTags on a field.

    {"tags": [{"ID": 7, "pose": {"translation": {"x": 0.0, "y": 5.5, "z": 1.45},
        "rotation": {"quaternion": {"W": 1.0, "X": 0.0, "Y": 0.0, "Z": 0.0}}}}],
     "field": {"length": 16.541, "width": 8.211}}

The tags are of one family and one size, and the file says neither. The field's frame, x along its
length and z up, is our world; `jaxnav.core.models.conventions` has the rotation from a tag to our
marker.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator, model_validator

from jaxnav.core.models.conventions import APRILTAG_FAMILIES, WXYZ_TAG_MARKER
from jaxnav.core.models.markers import CORNER_SIGNS, FAMILY_SIZES
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.markers import MarkerEntry
from jaxnav.files.ranges import within
from jaxnav.files.reading import first_repeated
from jaxnav.files.rigs import pose_entry
from jaxnav.files.validation import (
    Count,
    ForeignEntry,
    Number,
    Positive,
    QuaternionPose,
    Vector,
    at,
    unread_keys,
    validate,
)

SIZE_M = 0.1651  # the black square of FIRST's tags, 6.5 inches
FAMILY = "tag36h11"  # FIRST's since 2024


class _Quaternion(ForeignEntry):
    W: Number
    X: Number
    Y: Number
    Z: Number

    @model_validator(mode="after")
    def _of_length_1(self) -> "_Quaternion":
        poses.check_quaternion([self.W, self.X, self.Y, self.Z])
        return self


class _Rotation(ForeignEntry):
    quaternion: _Quaternion


class _TagPose(ForeignEntry):
    translation: Vector
    rotation: _Rotation


class _FieldTag(ForeignEntry):
    ID: Count
    pose: _TagPose


class _FieldSize(ForeignEntry):
    length: Annotated[Positive, within("position_m")]  # m
    width: Annotated[Positive, within("position_m")]  # m


class FieldLayout(ForeignEntry):
    """A field layout."""

    tags: Annotated[list[_FieldTag], Field(min_length=1, max_length=4096)]
    field: _FieldSize | None = None

    @field_validator("tags")
    @classmethod
    def _each_once(cls, tags: list[_FieldTag]) -> list[_FieldTag]:
        if (twice := first_repeated(tag.ID for tag in tags)) is not None:
            raise ValueError(f"tag {twice} is there twice")
        return tags


def is_layout(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like a field layout."""
    return "tags" in data


def layout_markers(
    path: Path, data: dict[str, Any], size_m: float = SIZE_M, family: str = FAMILY
) -> list[MarkerEntry]:
    """The markers of a field layout.

    Args:
        size_m: side of the black square of every tag.
        family: of all tags.

    Raises:
        BadInput: one line naming file and key.
    """
    layout = validate(FieldLayout, data, path)
    last_id = FAMILY_SIZES[family] - 1
    markers = []
    for index, tag in enumerate(layout.tags):
        marker_id = tag.ID
        if marker_id > last_id:
            problem = f"{family} has ids 0 to {last_id}, got {marker_id}"
            raise BadInput(at(path, f"tags[{index}].ID"), problem)
        place, turn = tag.pose.translation, tag.pose.rotation.quaternion
        wxyz = poses.quaternion_product([turn.W, turn.X, turn.Y, turn.Z], WXYZ_TAG_MARKER)
        pose = QuaternionPose.model_construct(wxyz=wxyz, xyz_m=place.xyz())
        markers.append(
            MarkerEntry.model_construct(
                id=marker_id, family=family, size_m=size_m, T_world_marker=pose
            )
        )
    return markers


def layout_left_out(data: dict[str, Any]) -> list[str]:
    """The keys that are not read and not empty, with the size of the field among them."""
    unread = unread_keys(data, ["tags", "field"])
    if data.get("field"):
        size = data["field"]
        unread.append(
            f"field ({size['length']} x {size['width']} m, --field-size-m on the way back)"
        )
    for index, tag in enumerate(data["tags"]):
        unread += unread_keys(tag, ["ID", "pose"], f"tags[{index}].")
    return unread


def layout_text(markers: Sequence[MarkerEntry], field_size_m: tuple[float, float]) -> str:
    """The markers as the text of a field layout.

    Args:
        field_size_m: length (along x) and width.

    Raises:
        BadInput: markers of several families or sizes, or of a family that WPILib does not know.
    """
    families = sorted({marker.family for marker in markers})
    if len(families) > 1 or families[0] not in APRILTAG_FAMILIES:
        raise BadInput(
            "--to wpilib: family",
            f"a layout has tags of one AprilTag family ({', '.join(APRILTAG_FAMILIES)}), these are "
            f"{', '.join(families)}: split the map",
        )
    sizes = sorted({marker.size_m for marker in markers})
    if len(sizes) > 1:
        sizes_text = ", ".join(f"{size_m:g}" for size_m in sizes)
        problem = f"a layout has tags of one size, these have {sizes_text} m: split the map"
        raise BadInput("--to wpilib: size_m", problem)
    length, width = field_size_m
    data = {
        "tags": [_tag(marker) for marker in markers],
        "field": {"length": length, "width": width},
    }
    return json.dumps(data, indent=2) + "\n"


def extent_m(markers: Sequence[MarkerEntry]) -> tuple[float, float]:
    """The extent (along x, along y), m, of the smallest box around the origin and all corners."""
    corners = [np.zeros((1, 2))]
    for marker in markers:
        T_world_marker = poses.matrix(poses.pose_as_read(marker.T_world_marker))
        corners_marker = marker.size_m / 2 * CORNER_SIGNS
        corners.append((corners_marker @ T_world_marker[:3, :3].T + T_world_marker[:3, 3])[:, :2])
    along_x, along_y = np.ptp(np.concatenate(corners), axis=0).tolist()
    return along_x, along_y


def _tag(marker: MarkerEntry) -> dict[str, Any]:
    written = marker.T_world_marker
    if isinstance(written, list):
        written = pose_entry(poses.pose_from_matrix(written))
    assert written is not None  # a marker of a map is placed
    w, x, y, z = WXYZ_TAG_MARKER
    W, X, Y, Z = poses.quaternion_product(written.wxyz, (w, -x, -y, -z))
    place = dict(zip("xyz", written.xyz_m, strict=True))
    rotation = {"quaternion": {"W": W, "X": X, "Y": Y, "Z": Z}}
    return {"ID": marker.id, "pose": {"translation": place, "rotation": rotation}}
