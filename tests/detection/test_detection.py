"""Detectors: which markers they find, and where, on photographs and on drawn scenes."""

import dataclasses
import importlib
import re

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import FAMILY_SIZES, MarkerMap
from jaxnav.detection import Detections, make_detector, marker_cells, observe
from jaxnav.detection.lens import Lens
from jaxnav.detection.observe import are_mirrored, double_area_px2
from jaxnav.detection.read import read_marker
from jaxnav.errors import BadInput
from tests import worlds
from tests.helpers.marker_images import Scene, random_scene, rotation
from tests.helpers.other_pictures import SETS, other_pictures

BACKENDS = ["aruco", "apriltag"]


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request):
    if request.param == "apriltag":
        pytest.importorskip("pyapriltags")
    return request.param


@pytest.fixture(scope="module")
def detector(backend):
    return make_detector(backend)


def listed_markers(path):
    """Ids and corners (4, 2), TL TR BR BL, pixel centres at integers, of a photograph's list."""
    markers = []
    for line in path.read_text().splitlines():
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", line)]
        # The list goes anticlockwise from the top right of OpenCV's picture.
        markers.append((int(numbers[0]), np.reshape(numbers[1:], (4, 2))[[1, 0, 3, 2]] - 0.5))
    return markers


def test_photographs(detector, data_dir):
    """OpenCV's decoder gives the outline of some from both sides of their edge: once is right."""
    listed = found = 0
    errors_px = []
    for photograph in sorted((data_dir / "apriltag_photos").glob("*.jpg")):
        detections = detector.detect(cv2.imread(str(photograph)))
        # The field uses one id: anything else would be made up.
        assert set(detections.ids.tolist()) <= {0}
        centers = detections.corners_px.mean(axis=1)
        apart_px = np.linalg.norm(centers[:, None] - centers, axis=2)
        assert np.min(apart_px + 1e3 * np.eye(len(centers))) > 8
        for marker_id, corners_px in listed_markers(photograph.with_suffix(".txt")):
            if np.linalg.norm(corners_px - np.roll(corners_px, 1, 0), axis=1).mean() < 20:
                continue
            listed += 1
            away = centers - corners_px.mean(axis=0)
            here = (detections.ids == marker_id) & (np.linalg.norm(away, axis=1) < 3)
            if here.any():
                found += 1
                errors = detections.corners_px[here][0] - corners_px
                errors_px.append(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    assert listed == 21
    assert found >= 0.95 * listed
    assert np.median(errors_px) < 0.5
    assert np.max(errors_px) < 2.5  # the same corner first, in all of them


def test_one_sighting_is_not_two():
    corners_px = np.array([[10.0, 10], [50, 10], [50, 50], [10, 50]])
    places_px = [corners_px, corners_px + 2, corners_px + 200, corners_px + 1, corners_px]
    seen = Detections(
        ids=np.array([3, 3, 3, 5, 3]),
        corners_px=np.stack(places_px),
        sigma_px=np.repeat([[0.2], [0.01], [0.3], [0.1], [0.4]], 4, axis=1),
        refined=np.array([True, True, True, False, True]),
        families=("tag36h11",) * 4 + ("4x4_50",),
    )
    kept = seen.once_each()
    assert kept.sigma_px[:, 0].tolist() == [0.01, 0.3, 0.1, 0.4]
    assert kept.ids.tolist() == [3, 3, 5, 3]
    assert len(Detections.concatenate([]).once_each()) == 0


def small_scene(rng, side_px, blur_px):
    """The paper's marker from afar: upright, 39 degrees off its normal, before a patterned wall."""
    direction = rng.uniform(0, 2 * np.pi)
    size_px = (200, 120)
    camera = Camera.create((319.0, 319.0), (99.5, 59.5))
    depth_m = 0.172 * 319 / side_px
    offset_m = rng.uniform(-15, 15, 2) * depth_m / 319
    return Scene(
        camera,
        size_px,
        rotation(np.deg2rad(39), rng.choice([-1, 1]) * np.pi / 2, rng.uniform(-0.1, 0.1)),
        np.append(offset_m, depth_m),
        0.172,
        marker_cells("tag36h11", 0),
        black=rng.uniform(20, 60),
        white=rng.uniform(150, 250),
        texture=20.0,
        optics_px=0.3,
        motion_px=(blur_px * np.cos(direction), blur_px * np.sin(direction)),
    )


@pytest.mark.parametrize(
    ("side_px", "blur_px", "needed"),
    [
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((14, 0, 12), (17, 2, 12))),
        (14, 2, 10),
    ],
)
def test_small_markers_are_found_from_cold(side_px, blur_px, needed):
    detector = make_detector("aruco")
    found, normalised = 0, []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        scene = small_scene(rng, side_px, blur_px)
        detections = detector.detect(scene.render(rng), scene.camera)
        assert set(detections.ids.tolist()) <= {0}
        if len(detections) == 1 and detections.refined[0]:
            found += 1
            errors = detections.corners_px[0] - scene.corners_px()
            normalised.append(errors / detections.sigma_px[0][:, None])
    assert found >= needed
    assert np.sqrt(np.mean(np.square(normalised))) < 1.3


def test_a_prediction_finds_what_a_cold_search_misses():
    detector = make_detector("aruco")
    cold = predicted = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        scene = small_scene(rng, 20, 4.0)
        image, corners_px = scene.render(rng), scene.corners_px()
        cold += len(detector.detect(image))
        guess_px = corners_px[None] + rng.normal(0, 1.5, (1, 1, 2))
        detections = detector.detect(image, predicted_corners_px=guess_px)
        predicted += len(detections)
        assert all(np.max(np.abs(c - corners_px)) < 0.5 for c in detections.corners_px)
    assert predicted >= 6
    assert predicted >= cold


def test_predictions_elsewhere_do_no_harm(detector):
    rng = np.random.default_rng(0)
    scene = random_scene(rng, 40, marker_cells("tag36h11", 5), optics_px=0.4)
    image = scene.render(rng)
    nowhere = np.stack([scene.corners_px() + 400, np.full((4, 2), np.nan), np.zeros((4, 2))])
    detections = detector.detect(image, predicted_corners_px=nowhere)
    assert detections.ids.tolist() == [5]
    assert np.max(np.abs(detections.corners_px[0] - scene.corners_px())) < 0.1


def test_every_family_opencv_knows():
    for family in FAMILY_SIZES:
        rng = np.random.default_rng(1)
        scene = random_scene(rng, 60, marker_cells(family, 7), view_max_rad=0.5, optics_px=0.4)
        detections = make_detector("aruco", family).detect(scene.render(rng))
        assert detections.ids.tolist() == [7], family
        assert detections.families == (family,)
        assert np.max(np.abs(detections.corners_px[0] - scene.corners_px())) < 0.1, family


@pytest.mark.parametrize("family", ["tag16h5", "tag25h9", "tag36h11"])
def test_apriltag_has_the_corners_of_opencv(family):
    pytest.importorskip("pyapriltags")
    rng = np.random.default_rng(2)
    scene = random_scene(rng, 60, marker_cells(family, 7), view_max_rad=0.5, optics_px=0.4)
    image = scene.render(rng)
    detections = make_detector("apriltag", family).detect(image)
    assert detections.ids.tolist() == [7]
    assert detections.refined.all()
    assert np.max(np.abs(detections.corners_px[0] - scene.corners_px())) < 0.1
    other = make_detector("aruco", family).detect(image)
    assert np.max(np.abs(detections.corners_px - other.corners_px)) < 0.02


def test_nothing_is_found_where_nothing_is(detector):
    rng = np.random.default_rng(3)
    noise = rng.normal(128, 50, (200, 400))
    blocks = cv2.resize(rng.normal(128, 60, (50, 100)), (400, 200), interpolation=cv2.INTER_NEAREST)
    checks = np.kron(np.indices((10, 20)).sum(axis=0) % 2, np.ones((20, 20))) * 180 + 30
    for picture in (noise, blocks, checks, np.zeros((200, 400))):
        image = np.clip(picture, 0, 255).astype(np.uint8)
        detections = detector.detect(image)
        assert len(detections) == 0
        assert detections.corners_px.shape == (0, 4, 2)
        assert detections.sigma_px.shape == (0, 4)


def test_frames_with_other_cells_are_not_read():
    rng = np.random.default_rng(4)
    read = 0
    for _ in range(20):
        cells = np.pad(rng.integers(0, 2, (6, 6)).astype(float), 1)
        scene = random_scene(rng, 20, cells, view_max_rad=0.6, optics_px=0.4)
        read += read_marker(scene.render(rng), scene.corners_px(), "tag36h11", Lens()) is not None
    assert read == 0


def test_colour_and_grey_are_the_same(detector):
    rng = np.random.default_rng(5)
    image = random_scene(rng, 40, marker_cells("tag36h11", 5), optics_px=0.4).render(rng)
    grey, colour = detector.detect(image), detector.detect(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    assert np.array_equal(grey.corners_px, colour.corners_px)


def test_corners_of_markers_that_do_not_matter_stay_as_they_are_decoded(backend, detector):
    rng = np.random.default_rng(6)
    parts = [random_scene(rng, 40, marker_cells("tag36h11", n), optics_px=0.4) for n in (5, 9)]
    image = np.concatenate([part.render(rng) for part in parts], axis=1)
    all_of_them = detector.detect(image)
    assert all_of_them.refined.all()
    few = make_detector(backend, "tag36h11", {9}).detect(image)
    assert sorted(few.ids) == [5, 9]
    assert (few.ids[few.refined] == 9).all()
    assert few.refined.sum() == 1
    nine = np.flatnonzero(all_of_them.ids == 9)
    np.testing.assert_array_equal(few.corners_px[few.refined], all_of_them.corners_px[nine])
    (off_px,) = few.corners_px[~few.refined] - all_of_them.corners_px[all_of_them.ids == 5]
    assert np.all(np.abs(off_px) < 3 * few.sigma_px[~few.refined].max())


def test_what_is_no_image_is_refused(detector):
    for image in (np.zeros((4, 5)), np.zeros((4, 5, 2), np.uint8), np.zeros((0, 5), np.uint8)):
        with pytest.raises(BadInput, match="image"):
            detector.detect(image)


def test_unknown_names_are_refused(monkeypatch):
    with pytest.raises(BadInput, match="unknown 'yolo'"):
        make_detector("yolo")
    with pytest.raises(BadInput, match="unknown 'tag99h9'"):
        make_detector("aruco", "tag99h9")
    with pytest.raises(BadInput, match="none of the apriltag detector's"):
        make_detector("apriltag", "4x4_50")

    def without(name, *args):
        if name == "pyapriltags":
            raise ImportError(name)
        return original(name, *args)

    original = importlib.import_module
    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(BadInput, match=re.escape("pip install 'jaxnav[apriltag]'")):
        make_detector("apriltag")


def test_clean_markers_are_found_where_another_renderer_drew_them():
    detector = make_detector("aruco")
    errors = []
    for image, truth in other_pictures("clean"):
        found = detector.detect(image)
        assert found.ids.tolist() == [truth.id]
        errors.append(found.corners_px[0] - truth.corners_px)
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.02  # no half pixel, nor a part of one


def test_no_marker_is_read_where_there_is_none():
    detector = make_detector("aruco")
    for image, truth in other_pictures("negatives"):
        shown = [truth.more["shown_id"]] if truth.more.get("shown_family") == truth.family else []
        assert set(detector.detect(image).ids.tolist()) <= set(shown)


@pytest.mark.parametrize("kind", SETS)
def test_the_truth_agrees_with_itself(kind):
    """The pose through the camera gives the corners; what is said of blur and sides holds."""
    for image, truth in other_pictures(kind):
        h = truth.size_m / 2
        corners = np.array([[-h, h, 0, 1], [h, h, 0, 1], [h, -h, 0, 1], [-h, -h, 0, 1]])
        x, y, z, _ = np.array(truth.more["T_camera_marker"]) @ corners.T
        ahead = np.stack([x / z, y / z], axis=1)
        seen = np.asarray(truth.camera.focal_px) * ahead + np.asarray(truth.camera.center_px)
        np.testing.assert_allclose(seen, truth.corners_px, atol=1e-3)
        blur_px = float(np.linalg.norm(truth.streak_px))
        assert kind == "negatives" or abs(blur_px - {"blur4": 4, "blur8": 8}.get(kind, 0)) < 0.01
        assert image.shape == (100, 120)
        assert image.dtype == np.uint8


def a_map(ids, families):
    poses = jaxlie.SE3(jnp.tile(jnp.array([1.0, 0, 0, 0, 0, 0, 0]), (len(ids), 1)))
    return MarkerMap(poses, jnp.full(len(ids), 0.1), ids, families)


def some(ids, family="tag36h11"):
    n = len(ids)
    corners_px = np.arange(n * 8, dtype=float).reshape(n, 4, 2) + 1
    sigma_px = np.full((n, 4), 0.02)
    return Detections(np.array(ids, int), corners_px, sigma_px, np.ones(n, bool), (family,) * n)


def test_observe_puts_detections_into_the_order_of_the_map():
    markers = a_map((4, 2, 9), ("tag36h11", "tag36h11", "tag25h9"))
    mixed = Detections.concatenate([some([9, 2]), some([9], "tag25h9")])
    observed = observe([some([2, 4]), some([]), mixed], markers)
    assert observed.visible.tolist() == [[True, True, False], [False] * 3, [False, True, True]]
    assert np.array_equal(observed.corners_px[0, 0], some([2, 4]).corners_px[1])
    assert np.array_equal(observed.corners_px[2, 1], mixed.corners_px[1])
    assert np.array_equal(observed.corners_px[2, 2], mixed.corners_px[2])
    assert observed.unknown == 1  # id 9 of another family
    assert observed.duplicates == 0
    assert np.all(observed.sigma_px[observed.visible] == 0.02)
    assert np.all(observed.sigma_px[~observed.visible] == 1)
    assert np.all(observed.corners_px[~observed.visible] == 0)


def test_observe_drops_both_of_two_equal_ones():
    observed = observe([some([4, 4, 2]), some([4])], a_map((4, 2), ("tag36h11",) * 2))
    assert observed.visible.tolist() == [[False, True], [True, False]]
    assert observed.duplicates == 2


# The order in which a detector may list corners that it does not list TL TR BR BL.
ANTICLOCKWISE = ([0, 3, 2, 1], [1, 0, 3, 2], [2, 1, 0, 3], [3, 2, 1, 0])
CLOCKWISE = ([0, 1, 2, 3], [1, 2, 3, 0], [2, 3, 0, 1], [3, 0, 1, 2])


@pytest.mark.parametrize("rig", [worlds.qcar_rig(), worlds.handheld_rig()], ids=["qcar", "rig"])
def test_no_marker_in_view_has_the_winding_of_one_seen_from_behind(rig):
    """From anywhere, rolled cameras and the edges of wide lenses included, up to 2 px of noise."""
    rng, markers = np.random.default_rng(0), worlds.room_markers()
    seen = 0
    for _ in range(60):
        turn = jaxlie.SO3.exp(jnp.asarray(rng.normal(size=3) * [0.2, 0.2, 3.0]))
        place_m = jnp.asarray([*rng.uniform(-1.2, 1.2, 2), rng.uniform(0.0, 0.5)])
        T = jaxlie.SE3.from_rotation_and_translation(turn, place_m)
        obs = worlds.observe(rig, markers, T)
        shown = np.asarray(obs.visible)
        corners_px = np.asarray(obs.corners_px)[shown]
        sigma_px = rng.uniform(0.05, 2.0)
        noisy_px = corners_px + sigma_px * rng.normal(size=corners_px.shape)
        assert not are_mirrored(noisy_px, np.full((len(noisy_px), 4), sigma_px)).any()
        large = double_area_px2(corners_px) > 20**2
        for order in ANTICLOCKWISE:
            assert are_mirrored(noisy_px[large][:, order], np.full((sum(large), 4), 2.0)).all()
        for order in CLOCKWISE:
            assert not are_mirrored(noisy_px[:, order], np.full((len(noisy_px), 4), 2.0)).any()
        seen += len(noisy_px)
    assert seen > 100


def test_a_marker_seen_edge_on_is_not_mirrored_by_its_noise():
    """Its corners lie on a line: half of the draws have the other winding."""
    rng, sigma_px = np.random.default_rng(1), np.full((100_000, 4), 0.5)
    line_px = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 30.0], [0.0, 30.0]])
    drawn_px = line_px + 0.5 * rng.normal(size=(len(sigma_px), 4, 2))
    assert 0.4 < np.mean(double_area_px2(drawn_px) < 0) < 0.6
    assert not are_mirrored(drawn_px, sigma_px).any()


def test_observe_drops_what_is_listed_the_other_way_round():
    right_px = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [0.0, 30.0]])
    found = dataclasses.replace(some([4, 2]), corners_px=np.stack([right_px, right_px[::-1]]))
    observed = observe([found], a_map((4, 2), ("tag36h11",) * 2))
    assert observed.visible.tolist() == [[True, False]]
    assert observed.mirrored == 1
