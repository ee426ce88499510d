"""Collection of the views of a board from images, folders of images and videos."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.detection import BoardLook, look_at
from jaxnav.calibrate.board.mismatch import what_is_seen
from jaxnav.calibrate.lens.views import BoardView, BoardViews
from jaxnav.core.models.camera import Camera
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


Bar = Callable[..., Iterable[Any]]  # the items that it is given


@dataclass(frozen=True)
class CollectedViews:
    """The views of a board, and the reasons why other images gave none.

    Attributes:
        views: the input of the calibration.
        files: all files read, in order, for the hash of the data.
        duplicates: (name, name of the image that it repeats).
        unreadable: (name, why it can't be read).
        without_board: names of images in which the board is not seen.
        foreign_ids: ids seen often of the board's family that are not on the board.
        other_pattern: true if a charuco board is seen in the pattern that its file does not say.
    """

    views: BoardViews
    files: tuple[Path, ...]
    duplicates: tuple[tuple[str, str], ...]
    unreadable: tuple[tuple[str, str], ...]
    without_board: tuple[str, ...]
    foreign_ids: tuple[int, ...]
    other_pattern: bool


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
        camera: see `find_board`.
        bar: shows progress, as `tqdm` does, which it takes the arguments of.

    Raises:
        BadInput: none of the images can be read, a video can't be, images differ in size, or the
            board is not seen; the message then says what is seen instead.
    """
    files = source_files(sources)
    collector = _Collector(board, camera)
    names = _names(files)
    for file, name in bar(zip(files, names, strict=True), total=len(files)):
        if file.suffix.lower() in VIDEOS:
            collector.add_video(file, name, bar(_frames(file), unit=" frame", leave=False))
        else:
            collector.add_image(file, name)
    return collector.collected(files)


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


class _Collector:
    """Collects views image by image and remembers why images gave none."""

    def __init__(self, board: Board, camera: Camera | None):
        self._board, self._camera = board, camera
        self._size_px: tuple[int, int] | None = None
        self._first = ""
        self._digests: dict[bytes, str] = {}
        self._views: list[BoardView] = []
        self._looks: list[BoardLook] = []
        self._duplicates: list[tuple[str, str]] = []
        self._unreadable: list[tuple[str, BadInput]] = []
        self._without: list[str] = []
        self._examples: list[np.ndarray] = []

    def add_image(self, file: Path, name: str) -> None:
        try:
            image = read_image(file, cv2.IMREAD_GRAYSCALE)
        except BadInput as error:
            self._unreadable.append((name, error))
            return
        self._same_size(str(file), image)
        if not self._is_repeated(name, image):
            look = self._look(name, image)
            if look.view is not None:
                self._views.append(look.view)

    def add_video(self, file: Path, name: str, frames: Iterable[tuple[int, np.ndarray]]) -> None:
        last_view: BoardView | None = None
        last_thumbnail: np.ndarray | None = None
        for number, image in frames:
            self._same_size(str(file), image)
            thumbnail = cv2.resize(image, _THUMBNAIL_PX, interpolation=cv2.INTER_AREA).astype(float)
            if last_thumbnail is not None:
                if np.mean(np.abs(thumbnail - last_thumbnail)) < _MIN_CHANGE_GREY:
                    continue
            view = self._look(f"{name}#{number}", image).view
            if view is None or _move_px(last_view, view) < _MIN_MOVE_PX:
                continue
            self._views.append(view)
            last_view, last_thumbnail = view, thumbnail

    def collected(self, files: tuple[Path, ...]) -> CollectedViews:
        if self._unreadable and not self._looks:
            raise self._unreadable[0][1]
        often = Counter(i for look in self._looks for i in look.foreign_ids)
        # A marker may hang in the room, and texture be read as one; a wrong board brings the same
        # several into most images.
        looks = len(self._looks)
        rare = min(max(1, looks / 4), looks - 1)
        foreign = sorted(i for i, count in often.items() if count > rare)
        strange = sum(len(set(foreign) & set(look.foreign_ids)) > 1 for look in self._looks)
        if strange > looks / 2 or not self._views:
            raise BadInput(
                files[0] if len(files) == 1 else files[0].parent,
                what_is_seen(self._board, self._looks, self._examples, foreign),
            )
        assert self._size_px is not None
        return CollectedViews(
            BoardViews(self._board.points_board_m, self._size_px, tuple(self._views)),
            files,
            tuple(self._duplicates),
            tuple((name, str(error).partition(": ")[2]) for name, error in self._unreadable),
            tuple(self._without),
            tuple(foreign),
            self._has_other_pattern(),
        )

    def _has_other_pattern(self) -> bool:
        seen = [look.board for look in self._looks if look.board is not None and look.view]
        other = sum(board.white_top_left != self._board.white_top_left for board in seen)
        return self._board.kind == "charuco" and other > len(seen) / 2

    def _look(self, name: str, image: np.ndarray) -> BoardLook:
        look = look_at(self._board, image, name, self._camera)
        self._looks.append(look)
        if look.view is None:
            self._without.append(name)
            if len(self._examples) < _EXAMPLES:
                self._examples.append(image)
        return look

    def _same_size(self, name: str, image: np.ndarray) -> None:
        height, width = image.shape
        if self._size_px is None:
            self._size_px, self._first = (width, height), name
        elif (width, height) != self._size_px:
            raise BadInput(
                name,
                f"is {width} x {height} pixels, but {self._first} is {self._size_px[0]} x "
                f"{self._size_px[1]}: calibrate one camera at one resolution",
            )

    def _is_repeated(self, name: str, image: np.ndarray) -> bool:
        digest = hashlib.sha256(np.ascontiguousarray(image).tobytes()).digest()
        if digest in self._digests:
            self._duplicates.append((name, self._digests[digest]))
            return True
        self._digests[digest] = name
        return False


def _frames(file: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Yield numbers and grey images (H, W) of a video's frames; every n-th if the video is long.

    Raises:
        BadInput: OpenCV can't read the file as a video.
    """
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
