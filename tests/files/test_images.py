"""One reader of images: the pixels as the camera stored them, whatever EXIF asks viewers for."""

import importlib.util
import io
import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxnav.errors import BadInput
from jaxnav.files.images import decode_image, open_video, read_image, read_photograph

SENSOR = cv2.GaussianBlur(
    np.random.default_rng(0).integers(0, 255, (48, 80, 3), np.uint8), (0, 0), 3
)  # (H, W, 3) BGR
FORMATS = {
    "JPEG": {"quality": 100, "subsampling": 0},
    "PNG": {},
    "TIFF": {},
    "WEBP": {"lossless": True},
}
# What turns the stored pixels upright for viewers, by EXIF's number.
SHOWN = {
    1: lambda x: x, 2: np.fliplr, 3: lambda x: np.rot90(x, 2), 4: np.flipud,
    5: lambda x: x.swapaxes(0, 1), 6: lambda x: np.rot90(x, -1),
    7: lambda x: np.rot90(x, 2).swapaxes(0, 1), 8: lambda x: np.rot90(x, 1),
}  # fmt: skip


def file_of(pixels: np.ndarray, orientation: int, kind: str) -> bytes:
    image, file = Image.fromarray(np.ascontiguousarray(pixels[:, :, ::-1])), io.BytesIO()
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(file, kind, exif=exif, **FORMATS.get(kind, {}))
    return file.getvalue()


@pytest.mark.parametrize("orientation", SHOWN)
@pytest.mark.parametrize("kind", FORMATS)
def test_pixels_come_as_the_sensor_stored_them(kind: str, orientation: int, tmp_path: Path) -> None:
    raw = file_of(SENSOR, orientation, kind)
    expected = SENSOR[:, ::-1] if orientation in (2, 4, 5, 7) else SENSOR
    image = decode_image(raw)
    assert image is not None
    (tmp_path / "a").write_bytes(raw)
    assert read_photograph(tmp_path / "a")[1] == orientation
    assert np.abs(image.astype(int) - expected).mean() < 2
    grey = decode_image(raw, cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    assert np.abs(grey.astype(int) - cv2.cvtColor(expected, cv2.COLOR_BGR2GRAY)).mean() < 2


def test_pixels_are_those_that_opencv_reads() -> None:
    """Of every format and depth, in colour and in grey."""
    deep, grey = SENSOR.astype(np.uint16) * 257, SENSOR[:, :, 0]
    alpha = np.dstack([SENSOR, grey])
    scans, binary, lzw = (
        cv2.IMWRITE_JPEG_PROGRESSIVE, cv2.IMWRITE_PXM_BINARY, cv2.IMWRITE_TIFF_COMPRESSION,
    )  # fmt: skip
    for extension, pixels, options in (
        (".jpg", SENSOR, []), (".jpg", SENSOR, [scans, 1]), (".jpg", grey, []),
        (".png", SENSOR, []), (".png", grey, []), (".png", alpha, []), (".png", deep, []),
        (".png", deep[:, :, 0], []), (".bmp", SENSOR, []), (".bmp", grey, []),
        (".tiff", SENSOR, []), (".tiff", SENSOR, [lzw, 1]), (".tiff", deep[:, :, 0], []),
        (".ppm", SENSOR, []), (".ppm", SENSOR, [binary, 0]), (".pgm", grey, []),
        (".webp", SENSOR, []), (".webp", SENSOR, [cv2.IMWRITE_WEBP_QUALITY, 50]),
        (".tiff", deep, []),
    ):  # fmt: skip
        raw = cv2.imencode(extension, pixels, options)[1]
        for flags in (cv2.IMREAD_COLOR, cv2.IMREAD_GRAYSCALE):
            image = decode_image(raw, flags)
            assert image is not None
            assert np.abs(image.astype(int) - cv2.imdecode(raw, flags)).max() == 0


@pytest.mark.parametrize("quarters", range(4))
def test_frames_of_a_video_come_as_the_sensor_stored_them(quarters: int, tmp_path: Path) -> None:
    """A phone held upright writes frames that lie, and a matrix by which players turn them."""
    file = tmp_path / "phone.mp4"
    frame = cv2.resize(SENSOR, (160, 96))
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"mp4v"), 10, frame.shape[1::-1])
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MP4")
    for _ in range(3):
        writer.write(frame)
    writer.release()
    raw = bytearray(file.read_bytes())
    header = raw.index(b"tkhd")
    assert raw[header + 4] == 0  # version
    c, s = round(np.cos(quarters * np.pi / 2)), round(np.sin(quarters * np.pi / 2))
    one = 1 << 16
    matrix = struct.pack(">9i", c * one, s * one, 0, -s * one, c * one, 0, 0, 0, 1 << 30)
    raw[header + 44 : header + 80] = matrix
    file.write_bytes(raw)
    turned = cv2.VideoCapture(str(file)).read()[1]
    assert (turned.shape[0] > turned.shape[1]) == (quarters % 2 == 1)  # OpenCV's own way
    got, image = open_video(file).read()
    assert got
    assert image.shape == frame.shape
    assert np.abs(image.astype(int) - frame).mean() < 8


@pytest.mark.parametrize("orientation", SHOWN)
def test_no_picture_comes_mirrored(orientation: int) -> None:
    """Whatever program stored an upright picture in another orientation, it can be turned back."""
    stored = next(
        pixels
        for turns in range(4)
        for pixels in (np.rot90(SENSOR, turns), np.fliplr(np.rot90(SENSOR, turns)))
        if np.array_equal(SHOWN[orientation](pixels), SENSOR)
    )
    image = decode_image(file_of(stored, orientation, "PNG"))
    assert image is not None
    assert any(np.array_equal(np.rot90(image, turns), SENSOR) for turns in range(4))


@pytest.mark.parametrize("quarters", range(4))
def test_a_heic_picture_comes_as_the_sensor_stored_it(quarters: int) -> None:
    """As phones do, the file asks viewers for a turn by a property of its own, `irot`."""
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    picture, exif = Image.fromarray(np.ascontiguousarray(SENSOR[:, :, ::-1])), Image.Exif()
    exif[0x0112] = 3
    picture.info["exif"], file = exif.tobytes(), io.BytesIO()
    heif.from_pillow(picture).save(file, quality=95)
    raw = bytearray(file.getvalue())
    assert raw.count(b"irot") == 1
    raw[raw.index(b"irot") + 4] = quarters
    image = decode_image(bytes(raw))
    assert image is not None
    assert image.shape == SENSOR.shape
    # This writer turned the pixels itself, so that half a turn shows what it was given.
    assert np.abs(np.rot90(image, 2).astype(int) - SENSOR).mean() < 2
    grey = decode_image(bytes(raw), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    assert grey.shape == SENSOR.shape[:2]


def test_without_its_reader_a_heic_picture_gets_a_hint(tmp_path: Path, monkeypatch) -> None:
    file = tmp_path / "IMG_1.HEIC"
    file.write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None)
    with pytest.raises(BadInput, match=r"HEIC picture: pip install 'jaxnav\[heic\]' reads it"):
        read_image(file)


def test_damaged_exif_is_no_reason_not_to_look() -> None:
    raw = file_of(SENSOR, 6, "JPEG")
    at = raw.index(b"Exif\0\0") + 6
    image = decode_image(raw[:at] + b"\xff" * 12 + raw[at + 12 :])
    assert image is not None
    assert image.shape == SENSOR.shape


def test_a_damaged_heic_picture_is_called_so(tmp_path: Path) -> None:
    pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    (tmp_path / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    with pytest.raises(BadInput, match="damaged HEIC picture"):
        read_image(tmp_path / "IMG_1.HEIC")


def test_what_is_no_picture_is_said_to_be_none(tmp_path: Path) -> None:
    for name, raw in {
        "a.heic": b"\0\0\0\x18ftypheic" + bytes(64),
        "b.jpg": b"\xff\xd8\xff\xe1\0\x20Exif\0\0MM\0*" + b"\xff" * 40,
        "c.png": b"",
        "d.png": b"no picture",
    }.items():
        assert decode_image(raw) is None
        (tmp_path / name).write_bytes(raw)
        with pytest.raises(BadInput, match=name):
            read_image(tmp_path / name)


def test_a_video_is_a_regular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "drive.mp4")
    with pytest.raises(BadInput, match=r"drive\.mp4: is a device, a pipe or a socket"):
        open_video(tmp_path / "drive.mp4")
