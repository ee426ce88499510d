"""Collection of the views of a board from images, folders of images and videos."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.detection import BoardLook, look_at
from jaxnav.calibrate.board.views import BoardView, BoardViews
from jaxnav.core.models.camera import Camera
from jaxnav.detection.families import LARGEST_FAMILIES, dictionary
from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.images import open_video, read_image

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm",
          ".heic", ".heif")  # fmt: skip
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mjpeg", ".mjpg")

_MOST_FRAMES = 600  # of one video that are searched
# A frame is searched when its thumbnail differs by this much from that of the last frame kept.
_THUMBNAIL_PX, _MIN_CHANGE_GREY = (64, 48), 1.5
_MIN_MOVE_PX = 10.0  # median distance of the board's points from where the last view has them
_EXAMPLES = 5  # images kept to find out why no board is seen
_MANY = 4  # markers in an image; fewer may be chance

Bar = Callable[..., Iterable[Any]]  # the items that it is given


@dataclass(frozen=True)
class CollectedViews:
    """The views of a board, and the reasons why other images gave none."""

    views: BoardViews  # the input of the calibration
    files: tuple[Path, ...]  # all files read, in order, for the hash of the data
    duplicates: tuple[tuple[str, str], ...]  # (name, name of the image that it repeats)
    unreadable: tuple[tuple[str, str], ...]  # (name, why it can't be read)
    without_board: tuple[str, ...]  # names of images in which the board is not seen
    other_pattern: bool  # true if a charuco board is seen in the pattern that its file does not say


def collect_views(
    board: Board,
    sources: Sequence[Path],
    camera: Camera | None = None,
    bar: Bar = lambda items, **_: items,
) -> CollectedViews:
    """Find the board in images and videos of one camera.

    Among images with the same pixels only the first counts. A frame of a video is taken if the
    board has moved since the last frame that was taken.

    Args:
        board: the board to look for.
        sources: folders of images, images, videos. The images of a folder are read in the order
            of their names, with numbers compared by value.
        camera: see `look_at`.
        bar: shows progress, as `tqdm` does, which it takes the arguments of.

    Raises:
        BadInput: none of the images can be read, a video can't be, images differ in size, or the
            board is not seen; the message then says what is seen instead.
    """
    files = source_files(sources)
    views: list[BoardView] = []
    looks: list[BoardLook] = []
    duplicates: list[tuple[str, str]] = []
    unreadable: list[tuple[str, BadInput]] = []
    without: list[str] = []
    examples: list[np.ndarray] = []
    digests: dict[bytes, str] = {}
    size_px, first = (0, 0), ""

    for file, name in bar(zip(files, _names(files), strict=True), total=len(files)):
        video = file.suffix.lower() in VIDEOS
        last_view: BoardView | None = None  # of this video
        last_thumbnail: np.ndarray = np.zeros(0)
        try:
            images = _frames(file) if video else [(0, read_image(file, cv2.IMREAD_GRAYSCALE))]
        except BadInput as error:
            unreadable.append((name, error))
            continue
        for number, image in bar(images, unit=" frame", leave=False) if video else images:
            shown_px = image.shape[1], image.shape[0]
            if not first:
                size_px, first = shown_px, str(file)
            elif shown_px != size_px:
                problem = (
                    f"is {shown_px[0]} x {shown_px[1]} pixels, but {first} is {size_px[0]} x "
                    f"{size_px[1]}: calibrate one camera at one resolution"
                )
                raise BadInput(str(file), problem)
            if not video:
                digest = hashlib.sha256(np.ascontiguousarray(image).tobytes()).digest()
                if digest in digests:
                    duplicates.append((name, digests[digest]))
                    continue
                digests[digest] = name
            thumbnail = cv2.resize(image, _THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
            if last_view is not None:
                if np.mean(cv2.absdiff(thumbnail, last_thumbnail)) < _MIN_CHANGE_GREY:
                    continue
            look = look_at(board, image, f"{name}#{number}" if video else name, camera)
            looks.append(look)
            if look.view is None:
                without.append(f"{name}#{number}" if video else name)
                examples += [image] if len(examples) < _EXAMPLES else []
            elif _move_px(last_view, look.view) >= _MIN_MOVE_PX:
                views.append(look.view)
                if video:
                    last_view, last_thumbnail = look.view, thumbnail

    if unreadable and not looks:
        raise unreadable[0][1]
    often = Counter(i for look in looks for i in look.foreign_ids)
    # A marker may hang in the room, and texture be read as one; a wrong board brings the same
    # several into most images.
    rare = min(max(1, len(looks) / 4), len(looks) - 1)
    foreign = sorted(i for i, count in often.items() if count > rare)
    strange = sum(len(set(foreign) & set(look.foreign_ids)) > 1 for look in looks)
    if strange > len(looks) / 2 or not views:
        where = files[0] if len(files) == 1 else files[0].parent
        raise BadInput(where, _what_is_seen(board, looks, examples, foreign))
    printed = [look.board for look in looks if look.board is not None and look.view]
    other = sum(one.white_top_left != board.white_top_left for one in printed)
    return CollectedViews(
        BoardViews(board.points_board_m, size_px, tuple(views)),
        files,
        tuple(duplicates),
        tuple((name, str(error).partition(": ")[2]) for name, error in unreadable),
        tuple(without),
        other_pattern=board.kind == "charuco" and other > len(printed) / 2,
    )


def source_files(sources: Sequence[Path]) -> tuple[Path, ...]:
    """The images and videos that the sources name, in order.

    Raises:
        BadInput: a source is neither image, video nor folder, or a folder has no images.
    """
    files: list[Path] = []
    for source in sources:
        if not source.exists():
            raise BadInput(source, "can't be read: no such file or folder")
        if not source.is_dir():
            if source.suffix.lower() not in IMAGES + VIDEOS:
                known = ", ".join(IMAGES + VIDEOS)
                raise BadInput(source, f"is neither a folder, an image nor a video ({known})")
            files.append(source)
            continue
        inside = sorted(
            (
                path
                for path in source.iterdir()
                if path.suffix.lower() in IMAGES and not path.name.startswith(".")
            ),
            key=_by_number,
        )
        if not inside:
            raise BadInput(source, f"has no images in it ({', '.join(IMAGES)})")
        files += inside
    if not files:
        raise BadInput("images", "none are given")
    return tuple(files)


def _names(files: Sequence[Path]) -> list[str]:
    """Names of the views: the file names, or whole paths where file names repeat."""
    names = [file.name for file in files]
    return [
        name if names.count(name) == 1 else str(file)
        for file, name in zip(files, names, strict=True)
    ]


def _by_number(path: Path) -> list[tuple[int, str]]:
    """A key that sorts 2.png before 10.png."""
    return [
        (int(part), "") if re.fullmatch("[0-9]{1,300}", part) else (-1, part)
        for part in re.split(r"([0-9]+)", path.name)
    ]


def _frames(file: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Yield numbers and grey images (H, W) of a video's frames; every n-th if the video is long."""
    capture = open_video(file)
    try:
        if not capture.isOpened():
            raise BadInput(file, "is not a video that OpenCV can read")
        width, height = map(capture.get, (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > limits.IMAGE_PIXELS:
            raise BadInput(file, f"has frames of {width:.0f} x {height:.0f} pixels, too many")
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        stride = max(1, -(-count // _MOST_FRAMES))
        number = 0
        while capture.grab():
            if number % stride == 0:
                got, image = capture.retrieve()
                if got:
                    if image.ndim == 3:
                        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
                    yield number, np.asarray(image)
            number += 1
    finally:
        capture.release()


def _move_px(before: BoardView | None, now: BoardView) -> float:
    """The median distance between the two views over the points that both have, px."""
    if before is None:
        return np.inf
    _, then, here = np.intersect1d(before.ids, now.ids, return_indices=True)
    if len(then) < 4:
        return np.inf
    apart_px = np.linalg.norm(now.corners_px[here] - before.corners_px[then], axis=1)
    return float(np.median(apart_px))


def _what_is_seen(
    board: Board, looks: Sequence[BoardLook], examples: Sequence[np.ndarray], foreign: Sequence[int]
) -> str:
    """Say in one line why the board is not found.

    Args:
        examples: some of the images without the board, (H, W) grey.
        foreign: ids that are often seen and not on the board.
    """

    def listed(ids: Sequence[int]) -> str:
        return ", ".join(map(str, ids[:6])) + ", ..." * (len(ids) > 6)

    own = sorted({marker_id for look in looks for marker_id in look.own_ids})
    if foreign:
        return (
            f"markers {listed(foreign)} of {board.family} are seen, which are not on the "
            f"{board}: describe the board that is in the images"
        )
    if len(own) >= _MANY:
        return (
            f"markers {listed(own)} are seen, but not arranged as on the {board}: check its kind, "
            "columns and rows"
        )
    whole = ""
    if board.kind == "chessboard" or board.has_discs:
        whole = f" All of a {'chessboard' if not board.has_discs else 'grid'} must be in the image."
    if board.kind == "chessboard":
        other = _largest_chessboard(examples)
        if other is not None and sorted(other) != sorted((board.columns, board.rows)):
            return (
                f"shows a chessboard of {other[0]} x {other[1]} squares, not the {board}: count "
                "the squares, not the corners between them"
            )
    elif not board.has_discs and (code := _other_code(examples)) is not None:
        return f"shows {code}, not the {board}: describe the board that is in the images"
    images = f"{len(looks)} image{'s' * (len(looks) != 1)}"
    return (
        f"no {board} is found in {images}: is it the right board, sharp, with white around it, and "
        f"at least some 20 px a square?{whole}"
    )


def _largest_chessboard(examples: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """Columns and rows, in squares, of the largest chessboard in the images."""
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    shapes = []
    for image in examples:
        success, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
        if success:
            rows, columns = np.shape(meta)
            shapes.append((columns + 1, rows + 1))
    return max(shapes, key=lambda shape: (shape[0] - 1) * (shape[1] - 1), default=None)


def _other_code(examples: Sequence[np.ndarray]) -> str | None:
    """Name in words the marker family that the images show instead."""
    most, named = _MANY - 1, None
    for family, border in product(LARGEST_FAMILIES, (1, 2)):
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        parameters.errorCorrectionRate = 0.0
        decoder = cv2.aruco.ArucoDetector(dictionary(family), parameters)
        for image in examples:
            _, ids, _ = decoder.detectMarkers(image)
            if ids is not None and len(ids) > most:
                most = len(ids)
                named = f"markers of {family} with a frame of {border} cell{'s' * (border > 1)}"
    return named
