"""Read a recorded drive: the pilot's inputs, its outcomes, and the cameras' images."""

import gc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Metadata

from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.validation import Model, validate
from jaxnav.recordings.drive_format import HEADER, decode, header_of
from jaxnav.recordings.mcap_messages import McapMessages, RecordedMessage
from jaxnav.recordings.message_schemas import (
    IMAGE_SCHEMA,
    MESSAGES,
    OUTCOME,
    AnyMessage,
    ImageMessage,
)
from jaxnav.recordings.messages import input_of
from jaxnav.recordings.outcomes import COLUMNS, OutcomeMessage, Outcomes


@dataclass(frozen=True)
class RecordedImage:
    """A JPEG image with its camera's timestamp."""

    topic: str
    stamp_ns: int
    jpeg: bytes


@dataclass(frozen=True)
class DriveLog:
    """A recorded drive.

    Attributes:
        header: as given to the recorder.
        inputs: in the order in which the pilot handled them.
        missing: topic -> number of its messages that were left out, as far as one can tell.
        truncated: the recording was cut off; what was written before is here.
    """

    path: Path
    header: dict[str, Any]
    inputs: tuple[Input, ...]
    outcomes: Outcomes
    missing: dict[str, int]
    truncated: bool

    def images(self, topic: str | None = None) -> Iterator[RecordedImage]:
        """Read the images from the file one by one, of one topic or, by default, of all.

        Raises:
            BadInput: an image is damaged.
        """
        for record in McapMessages(self.path):
            if isinstance(record, RecordedMessage) and record.schema == IMAGE_SCHEMA:
                if topic in (None, record.topic):
                    message = _checked(ImageMessage, record, self.path, record.topic)
                    yield RecordedImage(record.topic, record.stamp_ns, message.data)


def read_drive(path: str | Path, progress: Callable[[int], object] = lambda size: None) -> DriveLog:
    """Read a file of `Recorder`, to its end or as far as it goes.

    Args:
        progress: called with the size in bytes of each piece that was read; for a progress bar.

    Raises:
        BadInput: one line naming file and topic: not such a file, of a newer format, or damaged.
    """
    was_enabled = gc.isenabled()
    gc.disable()  # the search for cycles, a tenth of the time: a drive's messages have none
    try:
        return _read(Path(path), progress)
    finally:
        if was_enabled:
            gc.enable()


def _read(path: Path, progress: Callable[[int], object]) -> DriveLog:
    header: dict[str, Any] | None = None
    inputs: list[Input] = []
    # Values, not message objects: those take four times the memory.
    columns: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    detections = 0
    missing: dict[str, int] = {}
    last: dict[str, int] = {}  # topic -> its last sequence number
    records = McapMessages(path, progress)
    for record in records:
        if isinstance(record, Metadata):
            if record.name == HEADER and header is None:
                header = header_of(record.metadata, path)
            continue
        if (gap := record.sequence - last.get(record.topic, -1) - 1) > 0:
            missing[record.topic] = missing.get(record.topic, 0) + gap
        last[record.topic] = record.sequence
        if record.topic in MESSAGES:
            index = len(columns["now_ns"] if record.topic == OUTCOME else inputs)
            message = _message(record, path, index)
            if isinstance(message, OutcomeMessage):
                for name, value in vars(message).items():
                    columns[name].append(value)
                continue
            inputs.append(input_of(message))
            sightings = (frame.detections for frame in inputs[-1].frames)
            detections += sum(len(one) for one in sightings if one is not None)
            if detections > limits.DETECTIONS:
                problem = f"holds more than {limits.DETECTIONS} detections"
                raise BadInput(f"{path}: {record.topic}", problem)
    if header is None:
        problem = "is cut off before its header" if records.truncated else "is no recorded drive"
        raise BadInput(path, problem)
    table = Outcomes.of_values(columns, f"{path}: {OUTCOME}")
    return DriveLog(path, header, tuple(inputs), table, missing, records.truncated)


def _message(record: RecordedMessage, path: Path, index: int) -> AnyMessage:
    name, model = MESSAGES[record.topic]
    if (record.schema, record.encoding) != (name, "json"):
        problem = f"expected {name} in json, got {record.schema!r} in {record.encoding!r}"
        raise BadInput(f"{path}: {record.topic}", problem)
    if len(record.data) > limits.MESSAGE_BYTES:
        raise BadInput(f"{path}: {record.topic}[{index}]", f"has {len(record.data)} bytes")
    return _checked(model, record, path, f"{record.topic}[{index}]")


def _checked(model: type[Model], record: RecordedMessage, path: Path, key: str) -> Model:
    try:
        data = decode(record.data)
    except ValueError as error:
        raise BadInput(f"{path}: {key}", f"is not valid JSON: {error}") from None
    return validate(model, data, path, key)
