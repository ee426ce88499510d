"""The messages of a recorded drive: one model of each gives its JSON schema and its check.

    topic       schema              one for
    /odometry   jaxnav.Odometry     a reading of a car's odometer, as it was read
    /twist      jaxnav.Twist        a reading of another base's odometer
    /frames     jaxnav.Frames       what cameras saw at one instant
    /tick       jaxnav.Tick         an input without data
    /outcome    jaxnav.Outcome      what the pilot made of an input
    of images   foxglove.CompressedImage

The first four are the pilot's inputs, in the order in which it handled them. Each may hold what a
gyro has told since the one before.
"""

import json
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import BaseModel, Field, model_validator

from jaxnav.drive.interfaces import MOST_TURNS
from jaxnav.files import limits
from jaxnav.files.validation import Count, Entry
from jaxnav.recordings.drive_format import NOT_FINITE
from jaxnav.recordings.message_fields import (
    Array,
    Base64,
    Faults,
    Flag,
    Now,
    Real,
    Stamp,
    Word,
)
from jaxnav.recordings.outcomes import OUTCOME_MESSAGE, OutcomeMessage

ODOMETRY, TWIST, FRAMES, TICK, OUTCOME = "/odometry", "/twist", "/frames", "/tick", "/outcome"
IMAGE_SCHEMA = "foxglove.CompressedImage"


class SightedMessage(Entry):
    """A `FrameDetections` with N detections; N = 0 where the frame was not usable."""

    camera: Count
    stamp_ns: Stamp
    usable: Flag
    ids: Annotated[Int[np.ndarray, " N"], Array("integer")]
    families: list[Word]
    corners_px: Annotated[Float[np.ndarray, "N 4 2"], Array("number", (-1, 4, 2))]
    sigma_px: Annotated[Float[np.ndarray, "N 4"], Array("number", (-1, 4))]
    refined: Annotated[Bool[np.ndarray, " N"], Array("boolean")]
    faults: Faults

    @model_validator(mode="after")
    def _agrees(self) -> "SightedMessage":
        fields = (self.ids, self.families, self.corners_px, self.sigma_px, self.refined)
        if len({len(field) for field in fields}) > 1:
            raise ValueError("ids, families, corners_px, sigma_px and refined must agree in number")
        if len(self.ids) > limits.IN_VIEW:
            raise ValueError(f"has more than {limits.IN_VIEW} detections")
        if not self.usable and len(self.ids):
            raise ValueError("a frame that was not usable has no detections")
        return self


class GyroMessage(Entry):
    """A `GyroReading`."""

    stamp_ns: Stamp
    turn_radps: Real


class InputMessage(Entry):
    """What all inputs have."""

    now_ns: Now
    faults: Faults
    gyro: list[GyroMessage] = Field(default_factory=list, max_length=MOST_TURNS)


class OdometryMessage(InputMessage):
    """An `Input` with `Odometry`, and with the frames that showed nothing."""

    stamp_ns: Stamp
    speed_mps: Real
    steering_rad: Real
    valid: Flag
    frames: list[SightedMessage] = Field(default_factory=list)

    @property
    def values(self) -> tuple[float, ...]:
        """The values of the reading."""
        return self.speed_mps, self.steering_rad


class TwistMessage(InputMessage):
    """An `Input` with `TwistOdometry`, and with the frames that showed nothing."""

    stamp_ns: Stamp
    forward_mps: Real
    left_mps: Real
    turn_radps: Real
    valid: Flag
    frames: list[SightedMessage] = Field(default_factory=list)

    @property
    def values(self) -> tuple[float, ...]:
        """The values of the reading."""
        return self.forward_mps, self.left_mps, self.turn_radps


class FramesMessage(InputMessage):
    """An `Input` of frames that were handled together."""

    frames: Annotated[list[SightedMessage], Field(min_length=1)]


class TickMessage(InputMessage):
    """An `Input` without odometry and frames."""


class TimeMessage(Entry):
    """A time as Foxglove has it."""

    sec: Count
    nsec: Annotated[int, Field(strict=True, ge=0, lt=10**9)]


class ImageMessage(Entry):
    """A compressed image as Foxglove has it."""

    timestamp: TimeMessage
    frame_id: Word
    data: Base64
    format: Word


AnyInputMessage = OdometryMessage | TwistMessage | FramesMessage | TickMessage
AnyMessage = AnyInputMessage | OutcomeMessage

# topic -> the name of its schema and its model
MESSAGES: dict[str, tuple[str, type[AnyMessage]]] = {
    ODOMETRY: ("jaxnav.Odometry", OdometryMessage),
    TWIST: ("jaxnav.Twist", TwistMessage),
    FRAMES: ("jaxnav.Frames", FramesMessage),
    TICK: ("jaxnav.Tick", TickMessage),
    OUTCOME: ("jaxnav.Outcome", OUTCOME_MESSAGE),
}


def json_schema(model: type[BaseModel]) -> bytes:
    """The JSON schema of a model's messages as `encode` writes them, in the form that Foxglove
    reads: every type is one word, and there are no references."""
    schema = model.model_json_schema()
    return json.dumps(_simple(schema, schema.get("$defs", {}))).encode()


def _simple(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        return _simple(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:  # or null: then it is left out
        return _simple(schema["anyOf"][0], definitions)
    simple = {key: schema[key] for key in _KEPT if key in schema}
    if "items" in simple:
        simple["items"] = _simple(simple["items"], definitions)
    if "properties" in simple:
        fields = {key: _simple(inner, definitions) for key, inner in simple["properties"].items()}
        movable = [key for key, field in fields.items() if _may_be_infinite(field)]
        if movable:
            fields[NOT_FINITE] = {"type": "object", "properties": {}}
        simple["properties"] = fields
        simple["required"] = [key for key in schema.get("required", ()) if key not in movable]
    return simple


_KEPT = [
    "type",
    "enum",
    "contentEncoding",
    "minimum",
    "exclusiveMaximum",
    "items",
    "minItems",
    "properties",
    "additionalProperties",
]


def _may_be_infinite(field: dict[str, Any]) -> bool:
    return "number" in (field["type"], field.get("items", {}).get("type"))
