"""`jaxnav calibrate convert`: cameras and marker maps from one tool's file into another's."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxnav.commands.calibrate.arguments import CalibrateConvert
from jaxnav.core.models.rig import UNKNOWN_TIMING
from jaxnav.errors import BadInput, visible
from jaxnav.files import output_folder, wpilib
from jaxnav.files.cameras import camera_file, choose_camera
from jaxnav.files.kalibr import camchain_text, names_by_topic
from jaxnav.files.markers import MarkerEntry, MarkerFile, markers_left_out, markers_text
from jaxnav.files.matrix_cameras import camera_info_text, opencv_text, photonvision_text
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, place, rig_text
from jaxnav.files.validation import validate
from jaxnav.files.writing import atomic_write_all, refuse_overwriting

_MANY: dict[str, Callable[[Sequence[CameraEntry]], str]] = {
    "jaxnav": rig_text,
    "kalibr": camchain_text,
}
_ONE: dict[str, Callable[[CameraEntry], str]] = {
    "ros": camera_info_text,
    "opencv": opencv_text,
    "photonvision": photonvision_text,
}
_SUFFIXES = {"photonvision": (".json",), "wpilib": (".json",)}
_YAML = (".yaml", ".yml")


@dataclass(frozen=True)
class _Source:
    """The content of SOURCE: its format, cameras or markers, and what is not carried over."""

    format: str
    cameras: tuple[CameraEntry, ...]
    markers: tuple[MarkerEntry, ...]
    left_out: tuple[str, ...]


# What is written into each file, a word about each, and what is not carried over.
_Written = tuple[dict[Path, str], dict[Path, str], list[str]]


def run(args: CalibrateConvert) -> int:
    """Read SOURCE, write it in the other format, and print what was left out."""
    source = _read(args)
    _refuse_flags(args, source)
    if source.format == args.to:
        raise BadInput(args.source, f"is {args.to}'s already: nothing to convert")
    written = _markers(args, source) if source.markers else _cameras(args, source)
    contents, words, left_out = written
    refuse_overwriting("--out", contents, [args.source])
    for folder in {path.parent for path in contents}:
        output_folder(folder)
    atomic_write_all(contents)
    for path, what in words.items():
        print(f"{visible(path)}: {what}")
    if left_out:
        print(f"not carried over: {', '.join(left_out)}")
    return 0


def _read(args: CalibrateConvert) -> _Source:
    path = args.source
    data = read_mapping(path)
    if "markers" in data:
        map_file = validate(MarkerFile, data, path)
        markers = tuple(entry.placed() for entry in map_file.markers)
        return _Source("jaxnav", (), markers, tuple(markers_left_out(map_file)))
    if wpilib.is_layout(data):
        size_m = args.marker_size_m or wpilib.SIZE_M
        markers = tuple(wpilib.layout_markers(path, data, size_m, args.family or wpilib.FAMILY))
        return _Source("wpilib", (), markers, tuple(wpilib.layout_left_out(data)))
    file = camera_file(path, data, names_by_topic)
    return _Source(file.format, file.cameras, (), file.left_out)


def _refuse_flags(args: CalibrateConvert, source: _Source) -> None:
    """Raise BadInput for a flag that would have no effect."""
    layout, cameras = "goes with a WPILib layout as SOURCE", "goes with cameras as SOURCE"
    for flag, given, fits, problem in (
        ("--marker-size-m", args.marker_size_m, source.format == "wpilib", layout),
        ("--family", args.family, source.format == "wpilib", layout),
        ("--field-size-m", args.field_size_m, args.to == "wpilib", "goes with --to wpilib"),
        ("--camera-name", args.camera_name, bool(source.cameras), cameras),
        ("--position-m", args.position_m, bool(source.cameras), cameras),
        ("--position-m", args.position_m, args.to in _MANY, "goes with --to jaxnav or kalibr"),
    ):
        if given is not None and not fits:
            raise BadInput(flag, problem)


def _markers(args: CalibrateConvert, source: _Source) -> _Written:
    if args.to not in ("jaxnav", "wpilib"):
        raise BadInput(args.source, f"holds markers, and {args.to} does not: --to jaxnav or wpilib")
    markers, left_out = source.markers, list(source.left_out)
    count, one = f"{len(markers)} marker{'s' if len(markers) > 1 else ''}", markers[0]
    if args.to == "jaxnav":
        text = markers_text(markers)
        words = f"{count} of {one.family}, {one.size_m:g} m, as jaxnav's detectors see them"
    else:
        length, width = args.field_size_m or wpilib.extent_m(markers)
        if min(length, width) <= 0:
            raise BadInput("--field-size-m", "missing: the map has no extent to take it from")
        text = wpilib.layout_text(markers, (length, width))
        words = f"{count} on a field of {length:g} x {width:g} m"
        left_out.append(f"family {one.family}")
        left_out.append(f"size_m {one.size_m!r} (--marker-size-m on the way back)")
    _require_suffix(args.to, args.out)
    return {args.out: text}, {args.out: words}, left_out


def _cameras(args: CalibrateConvert, source: _Source) -> _Written:
    if args.to == "wpilib":
        raise BadInput(args.source, "holds cameras, and a WPILib layout holds markers")
    cameras, left_out = _chosen(args, source), list(source.left_out)
    words = [f"{c.name} {c.image_size_px[0]} x {c.image_size_px[1]} {c.lens}" for c in cameras]
    timed = [camera.name for camera in cameras if camera.timing != UNKNOWN_TIMING]
    if timed and args.to != "jaxnav":
        left_out.append(f"when the sensors of {', '.join(timed)} see (exposure_s, row_time_s)")
    if args.to in _MANY:
        _require_suffix(args.to, args.out)
        return {args.out: _MANY[args.to](cameras)}, {args.out: ", ".join(words)}, left_out
    paths = _paths(args, cameras)
    placed = [c.name for c in cameras if c.T_camera_vehicle is not None]
    bare = [c.name for c in cameras if c.lens == "none"]
    for names, what in (
        (placed, "where on the vehicle {} {}"),
        (bare, "that {} {} without lens: written as zeros"),
    ):
        if names:
            left_out.append(what.format(", ".join(names), "is" if len(names) == 1 else "are"))
    renamed = [c.name for c, path in zip(cameras, paths, strict=True) if c.name != path.stem]
    if renamed and args.to == "photonvision":
        left_out.append(f"the name{'s' if len(renamed) > 1 else ''} {', '.join(renamed)}")
    contents = [_ONE[args.to](camera) for camera in cameras]
    return (
        dict(zip(paths, contents, strict=True)),
        dict(zip(paths, words, strict=True)),
        left_out,
    )


def _chosen(args: CalibrateConvert, source: _Source) -> tuple[CameraEntry, ...]:
    """The cameras that the flags choose, with the name and place that the flags give."""
    cameras = source.cameras
    if args.camera_name is not None:
        if len(cameras) > 1:
            cameras = (choose_camera(args.source, cameras, args.camera_name),)
        else:
            cameras = (cameras[0].model_copy(update={"name": args.camera_name}),)
    if args.position_m is not None:
        if len(cameras) > 1:
            raise BadInput("--position-m", "is of one camera: choose it with --camera-name")
        if cameras[0].T_camera_vehicle is not None:
            raise BadInput("--position-m", f"{args.source} says where the camera is already")
        angles_deg = (args.yaw_deg, args.elevation_deg, args.roll_deg)
        placed = {"T_camera_vehicle": place(args.position_m, angles_deg)}
        cameras = (cameras[0].model_copy(update=placed),)
    return cameras


def _paths(args: CalibrateConvert, cameras: Sequence[CameraEntry]) -> list[Path]:
    """The output file of each camera: --out itself, or files in the folder --out."""
    suffixes = _SUFFIXES.get(args.to, _YAML)
    if len(cameras) == 1 and args.out.suffix and not args.out.is_dir():
        _require_suffix(args.to, args.out)
        return [args.out]
    if args.out.suffix in (*_YAML, ".json"):
        problem = f"{args.source} has {len(cameras)} cameras, and {args.to} takes a file each: "
        raise BadInput("--out", problem + "name a folder, or choose one with --camera-name")
    stems = [re.sub(r"[^\w.\-]+", "_", camera.name).strip("._") for camera in cameras]
    if not all(stems) or len({stem.lower() for stem in stems}) < len(stems):
        raise BadInput(args.source, f"{', '.join(c.name for c in cameras)} make no file names")
    return [args.out / f"{stem}{suffixes[0]}" for stem in stems]


def _require_suffix(to: str, path: Path) -> None:
    suffixes = _SUFFIXES.get(to, _YAML)
    if path.suffix.lower() not in suffixes:
        raise BadInput("--out", f"must be a file that ends in {suffixes[0]}, got {path}")
