"""Rendered images damaged on their way: the search's results, and the pilot's.

Nothing raises. Visible markers are found in their places, and no others are invented.
"""

from collections.abc import Callable

import cv2
import equinox as eqx
import numpy as np
import pytest

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.navigator import Navigator
from jaxnav.detection import ArucoDetector, make_detector, marker_cells
from jaxnav.detection.types import Detections
from jaxnav.drive.expect import Region
from jaxnav.drive.flags import Fault
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.packing import PackedLayout
from jaxnav.drive.pilot import FrameDetections, Input, Pilot
from jaxnav.drive.seeing import Search
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene
from jaxnav.sim.sensor import Sensor
from tests import worlds
from tests.helpers.drives import make_output

FAMILY = "tag36h11"
WIDTH_PX, HEIGHT_PX = SIZE_PX = (820, 410)
BEFORE_MARKER = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5), 0.0, 1.47 - 1.5, 0.0])
RADIUS_PX = 6.0
PAPER_PX = 12  # of white around the marker
BEGIN_NS, PERIOD_NS = 1_000_000_000, 33_000_000
MAX_PX = np.array(SIZE_PX) - 1
Change = Callable[[np.ndarray], np.ndarray | None]


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return worlds.qcar_rig()


@pytest.fixture(scope="module")
def camera(rig) -> Camera:
    return rig.camera(0)


@pytest.fixture(scope="module")
def image(rig) -> np.ndarray:
    """The front camera's, with the marker some 42 px large left of the middle."""
    sensor = Sensor(psf_sigma_px=0.7, read_noise_grey=2.0, full_well_e=6000.0)
    renderer = Renderer(Scene.create(worlds.paper_markers(), seed=0), rig, sensor=sensor, threads=1)
    return renderer.render_still(BEFORE_MARKER, np.random.default_rng(0))[0]


@pytest.fixture(scope="module")
def corners_px(rig) -> np.ndarray:
    """Where the marker is, (1, 4, 2)."""
    markers = worlds.paper_markers()
    T_vehicle_world = worlds.planar(0.0, 1.47 - 1.5, np.pi / 2).inverse()
    return np.asarray(rig.project(T_vehicle_world, markers.corners_world_m))[0]


def new_search(camera: Camera) -> Search:
    return Search(0, SIZE_PX, camera, [make_detector("aruco", FAMILY)])


def looked(
    camera: Camera, image: np.ndarray | None, region: Region | None = None
) -> FrameDetections:
    return new_search(camera).look(Frame(BEGIN_NS, image), region)


def around(corners_px: np.ndarray, off_px: float = 0.0) -> Region:
    """A region whose corners are all off by so much."""
    return Region(corners_px + off_px / np.sqrt(2), np.full(len(corners_px), RADIUS_PX))


def assert_found(found: Detections | None, corners_px: np.ndarray, within_px: float) -> None:
    """The paper's marker, once and there, its corners in their order."""
    assert found is not None
    assert found.ids.tolist() == [0]
    assert np.abs(found.corners_px - corners_px).max() < within_px


def paper(corners_px: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the marker with some white around it."""
    low = np.floor(corners_px[0].min(axis=0)).astype(int) - PAPER_PX
    high = np.ceil(corners_px[0].max(axis=0)).astype(int) + PAPER_PX + 1
    return slice(low[1], high[1]), slice(low[0], high[0])


def unknown_marker(marker_id: int) -> np.ndarray:
    """A print of 6 px a cell on white paper."""
    cells = cv2.copyMakeBorder(
        marker_cells(FAMILY, marker_id).astype(np.uint8), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=1
    )
    return np.kron(20 + 190 * cells, np.ones((6, 6), np.uint8)).astype(np.uint8)


def pasted(image: np.ndarray, patch: np.ndarray, row: int, column: int) -> np.ndarray:
    result = image.copy()
    result[row : row + patch.shape[0], column : column + patch.shape[1]] = patch
    return result


def blurred(image: np.ndarray, streak_px: int) -> np.ndarray:
    """Smeared over so many pixels in both directions, and not shifted."""
    kernel = np.ones(streak_px + 1, np.float32)
    kernel[[0, -1]] = 0.5
    return cv2.sepFilter2D(image, -1, kernel / streak_px, kernel / streak_px)


def test_what_is_seen_is_where_it_should_be(camera, image, corners_px):
    for same in (image, np.repeat(image[..., None], 3, axis=2)):
        sighted = looked(camera, same)
        assert sighted.faults == Fault(0)
        assert_found(sighted.detections, corners_px, 0.1)


NOISE = np.random.default_rng(1).integers(0, 256, (HEIGHT_PX, WIDTH_PX), dtype=np.uint8)


@pytest.mark.parametrize("where", ["anywhere", "near"])
def test_what_is_no_image_is_a_fault(camera, image, corners_px, drive, where):
    """All that is none: `test_an_image_that_can_not_be_used_is_said_to_be_so` of the loop."""
    region = around(corners_px) if where == "near" else None
    for changed in (None, np.zeros_like(image), image.T):
        sighted = looked(camera, changed, region)
        assert (sighted.detections, sighted.faults) == (None, Fault.FRAME_UNUSABLE)
        assert drive.handle(sighted) == (Fault.FRAME_UNUSABLE, False)


def lost_half(image: np.ndarray) -> np.ndarray:
    """Of 820 columns those with the marker, from 380 to 422, are in the half that is lost."""
    result = image.copy()
    result[:, :430] = 0
    return result


@pytest.mark.parametrize(
    "change",
    [lambda image: NOISE, lost_half, lambda image: cv2.GaussianBlur(image, (0, 0), 8.0)],
    ids=["noise", "lost half", "out of focus"],
)
@pytest.mark.parametrize("where", ["anywhere", "near"])
def test_where_no_marker_is_seen_none_is_made_up(camera, image, corners_px, change: Change, where):
    region = around(corners_px) if where == "near" else None
    sighted = looked(camera, change(image), region)
    assert sighted.faults == Fault(0)
    assert sighted.detections is not None
    assert len(sighted.detections) == 0


@pytest.mark.parametrize("where", ["anywhere", "near"])
def test_a_blurred_marker_is_found_and_less_is_promised(camera, image, corners_px, where):
    region = around(corners_px) if where == "near" else None
    sharp, blur = (
        looked(camera, one, region).detections for one in (image, blurred(image, streak_px=8))
    )
    assert_found(blur, corners_px, 0.5)
    assert blur.sigma_px.min() > 1.5 * sharp.sigma_px.max()


def test_upside_down_the_corners_keep_their_order(camera, image, corners_px):
    center_px = MAX_PX - np.asarray(camera.center_px)
    turned = Camera.create(
        np.asarray(camera.focal_px).tolist(), center_px.tolist(), lens="equidistant"
    )
    sighted = looked(turned, np.ascontiguousarray(image[::-1, ::-1]))
    assert_found(sighted.detections, MAX_PX - corners_px, 0.1)


OF_FRAMES = Fault.FRAME_UNUSABLE | Fault.FRAME_FROZEN | Fault.CORNERS_NOT_FINITE
OF_FRAMES |= Fault.UNKNOWN_MARKER | Fault.DUPLICATE_MARKER


class Drive:
    """A pilot that believes whatever: what it says of its frames is what counts."""

    def __init__(self, rig: CameraRig):
        navigator = Navigator(
            rig=rig,
            markers=worlds.paper_markers(),
            vehicle=worlds.qcar(),
            waypoints_m=worlds.WAYPOINTS_M,
        )
        made = make_output(np.random.default_rng(0))
        output = eqx.tree_at(
            lambda o: (o.pose_covariance, o.velocity_covariance), made, (1e-4 * np.eye(3),) * 2
        )
        packed = PackedLayout.from_tree(output).pack(output)
        self.pilot = Pilot(
            navigator, program=lambda belief, control, *_: (belief, belief, control, packed)
        )
        self.now_ns = BEGIN_NS

    def handle(self, sighted: FrameDetections) -> tuple[Fault, bool]:
        """What is wrong with a frame, and whether its corners were used."""
        self.now_ns += PERIOD_NS
        frame = FrameDetections(0, self.now_ns, sighted.detections, sighted.faults)
        outcome = self.pilot.handle(Input(self.now_ns, frames=(frame,)))
        return outcome.faults & OF_FRAMES, outcome.data is not None


@pytest.fixture
def drive(rig) -> Drive:
    return Drive(rig)


def test_a_marker_that_is_there_twice_is_not_believed(camera, image, corners_px, drive):
    rows, columns = paper(corners_px)
    sighted = looked(camera, pasted(image, image[rows, columns], rows.start, 500))
    assert sighted.detections.ids.tolist() == [0, 0]
    shift_px = np.array([500 - columns.start, 0.0])
    found = sorted(sighted.detections.corners_px, key=lambda quad: quad[0, 0])
    np.testing.assert_allclose(found, [corners_px[0], corners_px[0] + shift_px], atol=0.3)
    assert drive.handle(sighted) == (Fault.DUPLICATE_MARKER, False)
    assert drive.handle(looked(camera, image)) == (Fault(0), True)


def test_an_unknown_marker_is_told_of_and_the_known_one_used(camera, image, corners_px, drive):
    sighted = looked(camera, pasted(image, unknown_marker(17), 100, 500))
    assert sorted(sighted.detections.ids) == [0, 17]
    known = sighted.detections.corners_px[sighted.detections.ids == 0]
    np.testing.assert_allclose(known, corners_px, atol=0.1)
    assert drive.handle(sighted) == (Fault.UNKNOWN_MARKER, True)


@pytest.mark.parametrize("where", ["anywhere", "near"])
def test_a_frozen_image_is_noticed_at_the_third(camera, image, corners_px, drive, where):
    search = new_search(camera)
    region = around(corners_px) if where == "near" else None
    buffer = image.copy()
    seen = [drive.handle(search.look(Frame(n, buffer), region)) for n in range(4)]
    assert seen == [(Fault(0), True)] * 2 + [(Fault.FRAME_FROZEN, False)] * 2
    rows, columns = paper(corners_px)
    buffer[rows, columns] += NOISE[rows, columns] % 3  # the camera writes its next picture there
    sighted = search.look(Frame(9, buffer), region)
    assert_found(sighted.detections, corners_px, 0.2)
    assert drive.handle(sighted) == (Fault(0), True)


def test_where_it_is_expected_it_is_found_as_in_the_whole_image(
    camera, image, corners_px, monkeypatch
):
    whole = looked(camera, image).detections
    search = new_search(camera)
    monkeypatch.setattr(ArucoDetector, "detect", None)  # which looks everywhere
    near = search.look(Frame(BEGIN_NS, image), around(corners_px, RADIUS_PX)).detections
    assert_found(near, whole.corners_px, 0.05)


@pytest.mark.parametrize("size", [0.7, 1.5])
def test_it_may_be_larger_or_smaller_than_expected(camera, image, corners_px, size):
    """By as much as the radius says: near, and not by way of the whole image."""
    center = corners_px.mean(axis=1, keepdims=True)
    expected = center + size * (corners_px - center)
    radius_px = np.linalg.norm(expected - corners_px, axis=-1).max(axis=-1) + 1
    found = make_detector("aruco", FAMILY).detect_near(image, camera, expected, radius_px)
    assert_found(found, corners_px, 0.1)


def test_where_it_is_not_the_whole_image_is_looked_at(camera, image, corners_px):
    elsewhere = around(corners_px + np.array([250.0, 0.0]))
    assert_found(looked(camera, image, elsewhere).detections, corners_px, 0.1)
