"""A search that is warm has all that it calls, whatever there is to see: a thread that compiles or
loads a program hangs in the eyes of the guard. `tests/helpers/late.py` listens."""

import cv2
import jax
import jaxlie
import numpy as np
import pytest

from jaxnav.commands.drive.run import searches_for
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.conventions import APRILTAG_FAMILIES
from jaxnav.core.models.lenses import LENSES
from jaxnav.core.models.markers import FAMILY_SIZES, MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection import Tracker, make_detector
from jaxnav.detection.families import printed
from jaxnav.drive.expect import Region
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.seeing import Eyes, Search
from tests import worlds
from tests.helpers import late
from tests.helpers.other_pictures import other_pictures

# Typical coefficients: lenses that bend.
BENT = {
    "radtan": (-0.3, 0.1, 0.001, -0.001, 0.0),
    "rational": (0.1, 0.02, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0),
    "thin_prism": (-0.2, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.001, 0.0, 0.001, 0.0),
    "equidistant": (-0.02, 0.003, 0.0, 0.0),
    "omni": (1.2, -0.1, 0.02, 0.0, 0.0),
    "double_sphere": (-0.2, 0.6),
    "eucm": (0.6, 1.1),
}
SMALL, USUAL, LARGE = (160, 120), (820, 410), (1280, 720)
# Programs differ by the number of cells, of codes and the kind of lens, and nothing else: each
# family and each lens is there.
NAMES = ("family", "lens", "markers", "cameras", "size_px", "backend", "follow")
OFTEN = [
    ("tag16h5", "radtan", 2, 1, LARGE, "aruco", False),
    ("tag36h11", "omni", 1, 4, USUAL, "apriltag", False),
]
KINDS = [
    *OFTEN,
    ("tag25h9", "double_sphere", 5, 2, SMALL, "aruco", False),
    ("7x7_50", "none", 2, 2, LARGE, "aruco", False),
    ("aruco_mip_36h12", "eucm", 1, 1, SMALL, "aruco", False),
    ("tag25h9", "thin_prism", 5, 4, LARGE, "apriltag", False),
    ("4x4_50", "rational", 1, 2, USUAL, "aruco", False),
    ("tag16h5", "equidistant", 1, 1, USUAL, "apriltag", False),
    # Those of `follow` take long to compile: `make test` has them in test_track of the detection.
    ("tag16h5", "radtan", 2, 1, LARGE, "aruco", True),
    ("tag36h11", "omni", 1, 4, USUAL, "apriltag", True),
]
OTHERS = sorted(FAMILY_SIZES.keys() - {family for family, *_ in KINDS})


def some_often(often, every):
    """Cases of which most are for `make test-all`."""
    kinds = [one if isinstance(one, tuple) else (one,) for one in every]
    marks = [() if one in often else pytest.mark.long for one in every]
    return [pytest.param(*kind, marks=mark) for kind, mark in zip(kinds, marks, strict=True)]


def rig_of(lens: str, cameras: int, size_px: tuple[int, int]) -> CameraRig:
    width, height = size_px
    center_px = ((width - 1) / 2, (height - 1) / 2)
    one = Camera.create((0.5 * width, 0.5 * width), center_px, lens, BENT.get(lens, ()))
    places = [jaxlie.SE3.identity()] * cameras
    names = [f"camera {number}" for number in range(cameras)]
    return CameraRig.create([one] * cameras, places, names, [size_px] * cameras)


def markers_of(family: str, count: int) -> MarkerMap:
    """Markers whose ids are not those that a programmer would think of."""
    ids = tuple(FAMILY_SIZES[family] - 1 - 3 * number for number in range(count))
    worlds_own = worlds.marker_map([(np.eye(3), [0.0, 0.0, 1.0])] * count, [0.2] * count)
    return MarkerMap(worlds_own.Ts_world_marker, worlds_own.size_m, ids, (family,) * count)


def pictures(
    family: str, ids: tuple[int, ...], size_px: tuple[int, int], follow: bool
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pictures with each marker's corners (4, 2): sharp and small ones, at the border, blurred,
    smeared, half hidden, half in shadow, one of no map, and none."""
    width, height = size_px
    rng = np.random.default_rng(0)
    cell_px = max(height // 30, 2)

    def placed(marker_id: int, column: int, row: int, cell: int = cell_px):
        image = np.full((height, width), 150, np.uint8)
        marker, quad_px = printed(family, marker_id, cell)
        marker = marker[max(-row, 0) :, max(-column, 0) :]
        column_in, row_in = max(column, 0), max(row, 0)
        marker = marker[: height - row_in, : width - column_in]
        image[row_in : row_in + len(marker), column_in : column_in + marker.shape[1]] = marker
        return image, quad_px + np.array([column, row])

    seen = [placed(marker_id, width // 3, height // 3) for marker_id in ids]
    if follow:
        image, quad_px = seen[0]
        low, high = np.floor(quad_px[0]).astype(int), np.ceil(quad_px[2]).astype(int)
        middle = (low[0] + high[0]) // 2
        hidden, shaded, lost = image.copy(), image.copy(), image.copy()
        hidden[:, middle:] = 90
        shaded[:, middle:] = shaded[:, middle:] // 3
        lost[low[1] + 2 * cell_px : high[1] - 2 * cell_px, low[0] : middle + cell_px] = 255
        smear = np.full((1, 2 * cell_px + 1), 1 / (2 * cell_px + 1))
        seen += [(one, quad_px) for one in (hidden, shaded, lost)]
        seen.append((cv2.GaussianBlur(image, (0, 0), 1.2 * cell_px), quad_px))
        seen.append((cv2.filter2D(image, -1, smear), quad_px))
    seen.append(placed(ids[0], -2 * cell_px, height // 4))  # partly outside
    seen.append(placed(ids[0], 1, 1, 2))
    seen.append(placed(0, width // 2, height // 2))
    empty, quad_px = placed(0, width, height)
    empty[:50, :50] = rng.integers(0, 256, (50, 50), dtype=np.uint8)
    seen.append((empty, quad_px))
    noisy = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255) for image, _ in seen]
    return [(one.astype(np.uint8), quad_px) for one, (_, quad_px) in zip(noisy, seen, strict=True)]


def look_at_all(
    searches: list[Search], markers: MarkerMap, size_px: tuple[int, int], follow: bool
) -> int:
    """How many detections there were, in whole images and where several poses expect a marker."""
    family, found = markers.families[0], 0
    for number, (image, quad_px) in enumerate(pictures(family, markers.ids, size_px, follow)):
        search = searches[number % len(searches)]
        key = (family, markers.ids[0])
        decided = number % 2 == 0
        quads_px = np.stack([quad_px, quad_px + 3])
        within_px, flow_px_s = np.full(2, 6.0), np.full((2, 2), 40.0)
        region = Region(quads_px, within_px, (key, key), flow_px_s, 0, decided)
        frame = Frame(10 * number, np.dstack([image] * 3) if decided else image)
        found += len(search.look(frame, region).detections)
        found += len(search.look(Frame(10 * number + 5, image[:, ::-1].copy()), None).detections)
    return found


@pytest.mark.parametrize("precision", ["float32"], indirect=True)
@pytest.mark.parametrize(NAMES, some_often(OFTEN, KINDS))
def test_a_warm_search_calls_no_program_for_the_first_time(
    precision, family, lens, markers, cameras, size_px, backend, follow
):
    late.forget()
    rig, world = rig_of(lens, cameras, size_px), markers_of(family, markers)
    searches = searches_for(backend, rig, world, follow)
    Eyes([], searches, None, workers=0).start()
    assert look_at_all(searches, world, size_px, follow) > 0


def test_all_kinds_of_lenses_and_families_are_there():
    assert {lens for _, lens, *_ in KINDS} == LENSES.keys()
    assert {kind[5] for kind in KINDS} == {"aruco", "apriltag"}
    assert all(kind[0] in APRILTAG_FAMILIES for kind in KINDS if kind[5] == "apriltag")


@pytest.mark.parametrize("family", some_often(OTHERS[:2], OTHERS))
def test_so_of_every_family(family):
    """Of one lens, decoded only: four programs in all."""
    late.forget()
    world = markers_of(family, 1)
    searches = searches_for("aruco", rig_of("none", 1, SMALL), world)
    searches[0].warm_up()
    image, quad_px = pictures(family, world.ids, SMALL, follow=False)[0]
    region = Region(quad_px[None], np.array([6.0]))
    assert len(searches[0].look(Frame(0, image), region).detections) == 1
    searches[0].look(Frame(1, cv2.GaussianBlur(image, (0, 0), 4.0)), None)


@pytest.mark.long
def test_a_warm_search_compiles_nothing_whatever_there_is_to_see(data_dir):
    """Of photographs, and of pictures by another renderer."""
    late.forget()
    rig = jax.device_get(worlds.qcar_rig())
    width, height = rig.image_sizes_px[0]
    search = Search(
        0, (width, height), rig.camera(0), [make_detector("aruco", "tag36h11")], Tracker()
    )
    search.warm_up()
    found = 0
    for path in sorted((data_dir / "apriltag_photos").glob("*.jpg"))[:3]:
        photo = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        for scale in (1.0, 1.6):
            image = cv2.resize(photo, (round(width * scale), round(width * scale * 2 / 3)))
            image = np.ascontiguousarray(image[:height, :width])
            found += len(search.look(Frame(0, image), None).detections)
    assert found > 5
    image, truth = other_pictures("blur4")[0]
    image = cv2.copyMakeBorder(
        image, 0, height - len(image), 0, width - image.shape[1], cv2.BORDER_REPLICATE
    )
    keys = ((truth.family, truth.id),)
    search.look(Frame(1, image), Region(truth.corners_px[None], np.array([4.0]), keys))
