"""Markers that no decoder reads are found without a prediction, and nothing else is."""

from dataclasses import replace

import numpy as np

from jaxnav.detection import Acquirer, make_detector, marker_cells
from jaxnav.detection.acquire import acquire_in_photograph
from jaxnav.detection.restore import BlurredImage, likely_motions, motions
from tests.helpers.marker_images import random_scene
from tests.helpers.other_pictures import other_pictures

FAMILY = "tag36h11"
OTHERS = [(FAMILY, 3), (FAMILY, 77), ("tag25h9", 1)]


def along(one, streak_px) -> float:
    """The angle between a motion and a streak, of which neither has a sign, rad."""
    off = one.angle_rad - np.arctan2(streak_px[1], streak_px[0])
    return float(abs((off + np.pi / 2) % np.pi - np.pi / 2))


def test_blurred_markers_are_acquired_where_another_renderer_draws_them():
    decoder, read, errors = make_detector("aruco", FAMILY), 0, []
    pictures = [*other_pictures("blur4"), *other_pictures("blur8")][::3]
    for image, truth in pictures:
        read += truth.id in decoder.detect(image, truth.camera).ids
        found = Acquirer([(FAMILY, truth.id), *OTHERS]).detect(image, truth.camera)
        if len(found):
            assert found.ids.tolist() == [truth.id]
            assert found.families == (FAMILY,)
            errors.append(found.corners_px[0] - truth.corners_px)
            assert np.max(np.abs(errors[-1] / found.sigma_px[0][:, None])) < 8
    assert len(errors) >= 0.75 * len(pictures) > read
    assert np.sqrt(np.mean(np.square(errors))) < 0.2


def test_nothing_is_acquired_where_the_marker_is_not():
    for image, truth in other_pictures("negatives"):
        found = Acquirer([(FAMILY, truth.more["sought_id"])]).detect(image, truth.camera)
        assert not len(found)


def test_the_motion_is_seen_in_the_spectrum():
    images = [(likely_motions(image), truth) for image, truth in other_pictures("blur8")]
    off = [along(likely[0], truth.streak_px) for likely, truth in images]
    assert np.median(off) < np.deg2rad(15)  # by chance 45
    assert all(set(likely) == set(motions()) for likely, _ in images)


def test_a_restored_image_is_nearer_to_the_sharp_one():
    rng = np.random.default_rng(0)
    sharp = random_scene(rng, 60.0, marker_cells(FAMILY, 4)).render(rng)
    motion = motions()[-3]
    transfer = motion.transfer(
        np.fft.fftfreq(sharp.shape[1])[None], np.fft.fftfreq(sharp.shape[0])[:, None]
    )
    levels = np.fft.ifft2(np.fft.fft2(sharp.astype(float)) * transfer).real
    blurred = np.clip(levels, 0, 255).astype(np.uint8)
    restored = BlurredImage(blurred).restored(motion)
    assert restored.shape == sharp.shape
    inside = np.s_[12:-12, 12:-12]  # what lies beyond the border is not known

    def off(image):
        return np.mean((image.astype(float) - sharp)[inside] ** 2)

    assert off(restored) < 0.5 * off(blurred)


def test_a_large_photograph_is_halved():
    image, truth = next(
        (image, truth)
        for image, truth in other_pictures("blur8")
        if len(Acquirer([(FAMILY, truth.id)]).detect(image, truth.camera))
    )
    whole = np.full((900, 1200), int(np.median(image)), np.uint8)
    whole[400 : 400 + image.shape[0], 500 : 500 + image.shape[1]] = image
    large = np.repeat(np.repeat(whole, 2, axis=0), 2, axis=1)
    begin_px = np.array([500.5, 400.5])
    focal_px, center_px = 2 * truth.camera.focal_px, 2 * (truth.camera.center_px + begin_px) - 0.5
    camera = replace(truth.camera, focal_px=focal_px, center_px=center_px)
    found = acquire_in_photograph(large, camera, FAMILY)
    assert found.ids.tolist() == [truth.id]
    expected_px = 2 * (truth.corners_px + begin_px) - 0.5
    assert np.max(np.abs(found.corners_px[0] - expected_px)) < 1.0
