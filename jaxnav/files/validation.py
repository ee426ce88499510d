"""Types of the values in files, and messages about values that are not valid.

Files are validated by frozen pydantic models. `validate` turns the first error of pydantic into
one line with the file and the key: `rig.yaml: cameras.front.focal_px[0]: must be > 0, got 0`.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
)

from jaxnav.errors import BadInput
from jaxnav.files.poses import check_matrix, check_quaternion
from jaxnav.files.ranges import RANGES, placed_within, within
from jaxnav.files.reading import read_mapping


class Entry(BaseModel):
    """A mapping in a file of ours: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ForeignEntry(BaseModel):
    """A mapping in a file of another tool, which holds more than we read."""

    model_config = ConfigDict(frozen=True, extra="ignore")


# A number is a number: not text, not true/false, finite, and within what float32 can hold. `ranges`
# has the bounds of each quantity.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e9, le=1e9)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Size = Annotated[Positive, within("size_m")]
Radius = Annotated[Positive, within("radius_m")]
CornerSigma = Annotated[Positive, within("corner_sigma_px")]
Position = Annotated[Number, within("position_m")]
AngleDeg = Annotated[Number, within("angle_deg")]
Coefficient = Annotated[Number, within("distortion")]
_IMAGE = RANGES["image_px"]
Pixels = Annotated[int, Field(strict=True, ge=int(_IMAGE.least), le=int(_IMAGE.most))]
Count = Annotated[int, Field(strict=True, ge=0, le=2**31)]
Text = Annotated[str, Field(strict=True, min_length=1, max_length=200)]
# Starts like a word, so that no YAML reader takes it for a number or for true.
NAME_PATTERN = r"^[A-Za-z_/][\w/.\-]{0,99}$"
Name = Annotated[str, Field(strict=True, pattern=NAME_PATTERN)]

Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Point = Annotated[list[Number], Field(min_length=3, max_length=3)]
# A point in the world, and one on its floor.
Place = Annotated[list[Position], Field(min_length=3, max_length=3)]
FloorPlace = Annotated[list[Position], Field(min_length=2, max_length=2)]
# On a vehicle.
Mount = Annotated[list[Number], Field(min_length=3, max_length=3), placed_within("mount_m")]
PositivePair = Annotated[list[Positive], Field(min_length=2, max_length=2)]
ImageSize = Annotated[list[Pixels], Field(min_length=2, max_length=2)]


class Vector(ForeignEntry):
    """A vector x y z in a file: a position in m, or a rotation vector in rad."""

    x: Position
    y: Position
    z: Position

    def xyz(self) -> list[float]:
        """The vector as a list."""
        return [self.x, self.y, self.z]


_Row = Annotated[list[Number], Field(min_length=4, max_length=4)]
Matrix = Annotated[
    list[_Row], Field(min_length=4, max_length=4), AfterValidator(check_matrix)
]  # 4x4, rigid


class QuaternionPose(Entry):
    """A rigid transform as jaxlie stores it. We write this form because it reads back exactly."""

    wxyz: Annotated[
        list[Number], Field(min_length=4, max_length=4), AfterValidator(check_quaternion)
    ]
    xyz_m: Point


_Pose = Annotated[
    Annotated[QuaternionPose, Tag("<wxyz>")] | Annotated[Matrix, Tag("<4x4>")],
    Discriminator(lambda value: "<wxyz>" if isinstance(value, dict | QuaternionPose) else "<4x4>"),
]
Pose = Annotated[_Pose, placed_within("position_m")]  # in the world
MountMatrix = Annotated[Matrix, placed_within("mount_m")]
MountPose = Annotated[_Pose, placed_within("mount_m")]  # on a vehicle

Model = TypeVar("Model", bound=BaseModel)


class Wrong(ValueError):
    """What is wrong with one key of a mapping that a model checks as a whole."""

    def __init__(self, key: str, problem: str):
        super().__init__(problem)
        self.key = key


def validate(model: type[Model], data: Any, path: Path, prefix: str = "") -> Model:
    """Validate data as a model, or raise one line about the first error.

    Args:
        model: a pydantic model.
        data: the content of the file, or a part of it.
        path: the file, for the message.
        prefix: the key of that part in the file.

    Raises:
        BadInput: names file, key, the expected value and the value found.
    """
    try:
        return model.model_validate(data)
    except ValidationError as invalid:
        errors = invalid.errors(include_url=False)
    first = errors[0]
    problem = _problem(first, model)
    if len(errors) > 1:
        problem += f" (and {len(errors) - 1} more)"
    of_whole = first.get("ctx", {}).get("error")
    place = first["loc"] + ((of_whole.key,) if isinstance(of_whole, Wrong) else ())
    raise BadInput(at(path, prefix, _key(place, data)), problem)


def read(path: str | Path, model: type[Model]) -> Model:
    """Read the mapping in a YAML or JSON file as a model.

    Raises:
        BadInput: one line naming file and key.
    """
    return validate(model, read_mapping(Path(path)), Path(path))


def at(path: Path, *keys: str) -> str:
    """File and keys as `file: key.key[0]`, without keys that are empty."""
    dotted = "".join(key if key.startswith("[") else f".{key}" for key in keys if key)
    return f"{path}: {dotted.removeprefix('.')}" if dotted else str(path)


def _key(location: tuple[int | str, ...], data: Any) -> str:
    """The key in the file, with named list entries under their names: `cameras.front.lens`."""
    key = ""
    for part in location:
        if isinstance(part, str) and part.startswith("<"):
            continue  # the tag of a pose's form
        inside = None
        if isinstance(data, dict):
            inside = data.get(part)
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            inside = data[part]
        name = inside.get("name") if isinstance(inside, dict) else None
        if isinstance(part, int):
            key += f".{name}" if isinstance(name, str) and 0 < len(name) < 60 else f"[{part}]"
        else:
            key += f".{part}"
        data = inside
    return key.removeprefix(".")


def _problem(error: Any, model: type[BaseModel]) -> str:
    kind, context, got = error["type"], error.get("ctx", {}), show_value(error["input"])
    if kind == "missing":
        return "missing"
    if kind == "extra_forbidden":
        known = f": expected {', '.join(model.model_fields)}" if len(error["loc"]) == 1 else ""
        return f"unknown key{known}"
    if kind in ("too_short", "too_long"):
        least, most = context.get("min_length"), context.get("max_length")
        bound = f"at least {least}" if kind == "too_short" else f"at most {most}"
        return f"must have {bound} entries, got {context['actual_length']}"
    if kind in _EXPECTED:
        return f"{_EXPECTED[kind]}, got {got}"
    if kind in _BOUNDS:
        sign, limit = _BOUNDS[kind]
        return f"must be {sign} {context[limit]:g}, got {got}"
    if kind == "literal_error":
        return f"must be {context['expected']}, got {got}"
    if kind == "value_error":
        return str(context["error"])
    return f"{error['msg']}, got {got}"


_EXPECTED = {
    "float_type": "must be a number",
    "bool_type": "must be true or false",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "finite_number": "must be finite",
    "string_type": "must be text",
    "string_pattern_mismatch": "must be a name (a letter first, then letters, digits and _ - . /)",
    "string_too_short": "must not be empty",
    "string_too_long": "must be shorter",
    "list_type": "must be a list",
    "dict_type": "must be a mapping",
    "model_type": "must be a mapping",
    "model_attributes_type": "must be a mapping",
}
_BOUNDS = {
    "greater_than": (">", "gt"),
    "greater_than_equal": (">=", "ge"),
    "less_than": ("<", "lt"),
    "less_than_equal": ("<=", "le"),
}


def unread_keys(data: Mapping[str, Any], known: Iterable[str], prefix: str = "") -> list[str]:
    """The keys of a file, except the known ones, whose values are not empty, zero or false."""
    unread = []
    for key, value in data.items():
        if key not in known and _says_something(value):
            count = f" ({len(value)} entries)" if isinstance(value, list) else ""
            unread.append(f"{prefix}{key if key.isprintable() else ascii(key)}{count}")
    return unread


def _says_something(value: Any, levels: int = 8) -> bool:
    inner = list(value.values()) if isinstance(value, Mapping) else value
    if isinstance(inner, list) and levels:
        return any(_says_something(item, levels - 1) for item in inner)
    return bool(inner)


def show_value(value: Any) -> str:
    """A value as text, short enough for a line."""
    text = repr(value) if not isinstance(value, str) else f"the text {value!r}"
    return text if len(text) <= 60 else f"{text[:57]}..."
