"""What each message of a recorded drive holds: one model gives its JSON schema and its check.

    topic       schema              one for
    /odometry   jaxnav.Odometry     a reading of the odometer, as it was read
    /frames     jaxnav.Frames       what cameras saw at one instant
    /tick       jaxnav.Tick         an input without data
    /outcome    jaxnav.Outcome      what the pilot made of an input
    of images   foxglove.CompressedImage

The first three are the pilot's inputs, in the order in which it handled them.
"""

import json
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, model_validator

from jaxnav.files import limits
from jaxnav.files.validation import Count, Entry
from jaxnav.loop.flags import Health, Reject
from jaxnav.recording.drive_format import NOT_FINITE
from jaxnav.recording.message_fields import (
    Array,
    Base64,
    Faults,
    Flag,
    Index,
    Now,
    Real,
    Stamp,
    Word,
    Words,
    square,
)

ODOMETRY, FRAMES, TICK, OUTCOME = "/odometry", "/frames", "/tick", "/outcome"
IMAGE_SCHEMA = "foxglove.CompressedImage"


class SightedMessage(Entry):
    """See `Sighted`; N detections. None of them where the frame was not usable."""

    camera: Count
    stamp_ns: Stamp
    usable: Flag
    ids: Annotated[np.ndarray, Array("integer")]
    families: list[Word]
    corners_px: Annotated[np.ndarray, Array("number", (-1, 4, 2))]
    sigma_px: Annotated[np.ndarray, Array("number", (-1, 4))]
    refined: Annotated[np.ndarray, Array("boolean")]
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


class OdometryMessage(Entry):
    """See `Odometry`, and of `Input` what it has beside it: frames that showed nothing."""

    now_ns: Now
    stamp_ns: Stamp
    speed_mps: Real
    steering_rad: Real
    valid: Flag
    faults: Faults
    frames: list[SightedMessage] = Field(default_factory=list)


class FramesMessage(Entry):
    """Frames that were handled together."""

    now_ns: Now
    frames: Annotated[list[SightedMessage], Field(min_length=1)]
    faults: Faults


class TickMessage(Entry):
    """Nothing came."""

    now_ns: Now
    faults: Faults


class OutcomeMessage(Entry):
    """See `Outcome` and its report, without which all from `pose` on is missing. All poses are in
    the world.

    Attributes:
        covariance: (d, d).
        hypotheses: (K, 3), x_m y_m psi_rad of those that are alive.
        Ts_vehicle_world: (N, 7), wxyz_xyz of the candidates that are valid.
        selected: index into these, -1: none.
        digest: of the pilot's state, for who replays; "" where none was taken.
        outvoted: ids of markers that were left out; older drives have none.
    """

    now_ns: Now
    stamp_ns: Stamp | None = None
    health: Annotated[Health, Words(Health)]
    faults: Faults
    rejects: Annotated[Reject, Words(Reject)]
    steering_rad: Real
    throttle: Real
    restarts: Count
    reason: Word
    digest: Word
    pose: Annotated[np.ndarray, Array("number", (3,))] | None = None
    covariance: Annotated[np.ndarray, Array("number"), AfterValidator(square)] | None = None
    located: Flag = False
    decided: Flag = False
    done: Flag = False
    flip_probability: Real | None = None
    nis: Real | None = None
    hypothesis: Index | None = None
    hypotheses: Annotated[np.ndarray, Array("number", (-1, 3))] | None = None
    log_weight: Annotated[np.ndarray, Array("number")] | None = None
    Ts_vehicle_world: Annotated[np.ndarray, Array("number", (-1, 7))] | None = None
    costs: Annotated[np.ndarray, Array("number")] | None = None
    selected: Index | None = None
    outvoted: list[Count] = Field(default_factory=list)

    @model_validator(mode="after")
    def _is_whole(self) -> "OutcomeMessage":
        told = vars(self)
        missing = sum(told[name] is None for name in REPORTED)
        if 0 < missing < len(REPORTED):
            raise ValueError(f"must have all of {', '.join(REPORTED)}, or none")
        return self


REPORTED = [
    "pose",
    "covariance",
    "flip_probability",
    "nis",
    "hypothesis",
    "hypotheses",
    "log_weight",
    "Ts_vehicle_world",
    "costs",
    "selected",
]


class TimeMessage(Entry):
    """Foxglove's time."""

    sec: Count
    nsec: Annotated[int, Field(strict=True, ge=0, lt=10**9)]


class ImageMessage(Entry):
    """Foxglove's compressed image."""

    timestamp: TimeMessage
    frame_id: Word
    data: Base64
    format: Word


AnyMessage = OdometryMessage | FramesMessage | TickMessage | OutcomeMessage

# topic -> the name of its schema and its model
MESSAGES: dict[str, tuple[str, type[AnyMessage]]] = {
    ODOMETRY: ("jaxnav.Odometry", OdometryMessage),
    FRAMES: ("jaxnav.Frames", FramesMessage),
    TICK: ("jaxnav.Tick", TickMessage),
    OUTCOME: ("jaxnav.Outcome", OutcomeMessage),
}


def json_schema(model: type[BaseModel]) -> bytes:
    """The JSON schema of a model's messages as `encode` writes them, in what Foxglove reads of it:
    every type is one word, nothing refers to another place."""
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
