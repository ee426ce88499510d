"""The scenes of `other_renderer`, drawn by lot: numbers only, with NumPy.

blur4: sides of 14 to 17 px, a streak of 4 px. The others have sides of 20 to 40 px. blur8: a streak
of 8 px. shadow: an edge of shadow across the marker. hidden: 30 % of it behind something, or out of
the picture. clean: nothing of this. negatives: no such marker, sides of 14 to 40 px, streaks of 0,
4 or 8 px.
"""

from dataclasses import replace

import numpy as np
from other_scenes import CORNERS_M, FOCAL_PX, FULL_PX, SIZE_M, Scene, Thing, on_paper
from other_surfaces import (
    FAMILY,
    checker,
    coat,
    marker_paper,
    other_family,
    printed,
    text,
    wall,
)
from scipy.spatial.transform import Rotation

SETS = ("blur4", "blur8", "shadow", "hidden", "clean", "negatives")
HIDDEN_PART = 0.3
VIEW_MAX_RAD = np.deg2rad(50)


def draw(kind: str, index: int, seed: int = 0, size_px: tuple[int, int] = (160, 120)) -> Scene:
    """The scene of one picture of a set.

    Args:
        kind: one of `SETS`.
        index: of the picture in its set.
        seed: others give other pictures.
        size_px: (width, height) of the picture.
    """
    rng = np.random.default_rng([seed, SETS.index(kind), index])
    while True:
        scene = _seen(rng, kind, size_px)
        scene = _printed(scene, rng, kind, index)
        scene = _moved(scene, rng, kind)
        if kind == "shadow":
            scene = _shaded(scene, rng)
        if kind == "hidden":
            scene = _hidden(scene, rng, index)
        if not _fits(scene):
            continue
        scene = _cluttered(scene, rng)
        if kind != "shadow":
            return scene
        if (balanced := _balanced(scene)) is not None:
            return balanced


def _seen(rng: np.random.Generator, kind: str, size_px: tuple[int, int]) -> Scene:
    """A view of the marker by a camera at rest, and the light."""
    side_px = rng.uniform(*{"blur4": (14, 17), "negatives": (14, 40)}.get(kind, (20, 40)))
    view, tilt, roll = rng.uniform(0, VIEW_MAX_RAD), *rng.uniform(0, 2 * np.pi, 2)
    R = Rotation.from_rotvec(view * np.array([np.cos(tilt), np.sin(tilt), 0])).as_matrix()
    R = R @ Rotation.from_rotvec([0, 0, roll]).as_matrix() @ np.diag([1.0, -1, -1])
    place_px = np.array([rng.uniform(200, 440), rng.uniform(180, 300)])
    ray = np.append((place_px - (np.array(FULL_PX) - 1) / 2) / FOCAL_PX, 1)
    turn, _ = Rotation.align_vectors(ray[None] / np.linalg.norm(ray), [[0, 0, 1.0]])
    size = np.array(size_px)
    left, top = np.round(place_px - size / 2 + rng.uniform(-0.12, 0.12, 2) * size).astype(int)
    toward = _direction(rng, np.deg2rad(55))
    scene = Scene(
        turn.as_matrix() @ R,
        ray * FOCAL_PX * SIZE_M / side_px,
        np.zeros(3),
        np.zeros(3),
        (int(left), int(top), *size_px),
        None,
        0.0,
        wall(rng),
        (),
        toward * rng.uniform(1.2, 3.0),
        float(rng.uniform(0.02, 0.15)),
        float(rng.uniform(0.3, 0.7)),
        float(rng.uniform(0.6, 0.97)),
        float(rng.uniform(0.3, 0.5)),
        "srgb" if rng.random() < 1 / 3 else "linear",
    )
    for _ in range(20):
        scene = replace(scene, t_camera_world=scene.t_camera_world * scene.side_px() / side_px)
    return scene


def _direction(rng: np.random.Generator, within_rad: float) -> np.ndarray:
    """A unit vector (3,) so near to the marker's normal."""
    z = rng.uniform(np.cos(within_rad), 1)
    azimuth = rng.uniform(0, 2 * np.pi)
    return np.array([*(np.sqrt(1 - z**2) * np.array([np.cos(azimuth), np.sin(azimuth)])), z])


def _printed(scene: Scene, rng: np.random.Generator, kind: str, index: int) -> Scene:
    """With the paper on the wall."""
    sought = int(rng.integers(587))
    truth: dict = {"id": sought}
    pattern: np.ndarray | None = marker_paper(FAMILY, sought)
    if kind == "negatives":
        what = ("room", "other_id", "other_family", "checker", "text")[index % 5]
        truth = {"id": None, "sought_id": sought, "panel": what}
        family, marker_id = FAMILY, (sought + int(rng.integers(1, 587))) % 587
        if what == "other_family":
            family, marker_id = other_family(rng)
        if what.startswith("other"):
            pattern = marker_paper(family, marker_id)
            truth |= {"shown_family": family, "shown_id": marker_id}
        else:
            pattern = {"room": lambda _: None, "checker": checker, "text": text}[what](rng)
    if pattern is None:
        return replace(scene, truth=truth)
    cells = len(pattern)
    panel_m = SIZE_M * (1.25 if cells > 50 else cells / (cells - 2))
    return replace(scene, panel=printed(pattern, rng), panel_m=panel_m, truth=truth)


def _moved(scene: Scene, rng: np.random.Generator, kind: str) -> Scene:
    """Moving so that the marker's centre draws a streak of the set's length."""
    blur_px = {"blur4": 4.0, "blur8": 8.0}.get(kind, 0.0)
    if kind == "negatives":
        blur_px = float(rng.choice([0, 4, 8]))
    if blur_px == 0:
        return scene
    # Turning blurs far things as well, and is how vehicles mostly blur; then translation, or both.
    turning, sliding = [(1, 0), (1, 0), (0, 1), (1, 1)][rng.integers(4)]
    angular = turning * rng.standard_normal(3) * [1, 1, 0.4]
    linear = sliding * rng.standard_normal(3) * [1, 1, 0.4] * np.linalg.norm(scene.t_camera_world)
    factor = 1.0
    for _ in range(20):
        scene = replace(scene, angular_rad_s=factor * angular, linear_m_s=factor * linear)
        factor *= blur_px / float(np.linalg.norm(scene.streaks_px()[0]))
    return scene


def _cluttered(scene: Scene, rng: np.random.Generator) -> Scene:
    """With things on the wall and a floor, none of which hides or shades the paper."""
    grid = on_paper(9, 1.3 * SIZE_M)
    side = np.array([rng.choice([-1, 1]) * rng.uniform(0.4, 1.5), 0, 1.0])
    below = np.array([0, -rng.uniform(0.3, 1.2), 1.0])
    plain = [np.full((1, 1), rng.uniform(0.1, 0.7)) for _ in range(2)]
    things = [
        Thing("box", np.eye(3), side, np.array([0.02, 4, 1.0]), plain[0]),
        Thing("box", np.eye(3), below, np.array([4, 0.02, 1.0]), plain[1]),
    ]
    for _ in range(40):
        if len(things) == 14:
            break
        angle, away = rng.uniform(0, 2 * np.pi), SIZE_M * rng.uniform(0.8, 3.5)
        half = SIZE_M * rng.uniform(0.08, 0.7, 3) * np.array([1, 1, 0.7])
        place = np.array([away * np.cos(angle), away * np.sin(angle), half[2] * rng.uniform(0, 1)])
        kind = str(rng.choice(["box", "box", "capsule"]))
        R = Rotation.from_rotvec([0, 0, rng.uniform(0, np.pi)]).as_matrix()
        if kind == "capsule":
            R = Rotation.random(random_state=rng).as_matrix()
            half[1] = half[0]
        things.append(Thing(kind, R, place, half, coat(rng)))
    eyes = [scene.eye(), scene.light_m]
    clear = [t for t in things if not any(np.any(t.hides(eye, grid)) for eye in eyes)]
    return replace(scene, things=(*scene.things, *clear))


def _shaded(scene: Scene, rng: np.random.Generator) -> Scene:
    """With a plate before the lamp, whose shadow's edge runs across the marker."""
    along, lit_part = rng.uniform(0.15, 0.4), rng.uniform(0.3, 0.6)
    angle, offset_m = rng.uniform(0, 2 * np.pi), SIZE_M * rng.uniform(-0.15, 0.15)
    n = np.array([np.cos(angle), np.sin(angle), 0])
    edge = offset_m * n + along * (scene.light_m - offset_m * n)
    half = SIZE_M * np.array([rng.uniform(0.45, 0.9), rng.uniform(0.8, 1.2), 0.001])
    R = np.stack([n, np.cross([0, 0, 1.0], n), [0, 0, 1.0]], axis=1)
    plate = Thing("box", R, edge + half[0] * n, half, coat(rng))
    penumbra_px = rng.uniform(0, 2)
    radius_m = penumbra_px * SIZE_M / scene.side_px() * (1 - along) / along / 2
    e = R[:, 1] * SIZE_M
    ends_px = scene.project(np.array([offset_m * n - e, offset_m * n + e]))
    return replace(
        scene,
        things=(plate,),
        light_radius_m=max(float(radius_m), 1e-4),
        truth=scene.truth
        | {
            "shadow": {
                "light_left": float(lit_part),
                "penumbra_px": float(penumbra_px),
                "edge_px": ends_px.tolist(),
            }
        },
    )


def _balanced(scene: Scene) -> Scene | None:
    """With so much of the light from the lamp that the shadow is as dark as was drawn.

    The things keep out some of the light from around as well. None where that alone is too dark.
    """
    left = scene.truth["shadow"]["light_left"]
    points = on_paper(6, SIZE_M)
    shaded = np.any([t.hides(scene.light_m, points) for t in scene.things], axis=0)
    rng = np.random.default_rng(0)
    z, azimuth = np.sqrt(rng.random(400)), rng.uniform(0, 2 * np.pi, 400)  # by Lambert's law
    r = np.sqrt(1 - z**2)
    sky = 10 * np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)
    around = np.array(
        [1 - np.mean(np.any([t.hides(p, p + sky) for t in scene.things], axis=0)) for p in points]
    )
    if shaded.all() or not shaded.any():
        return None
    dark, bright = around[shaded].mean(), around[~shaded].mean()
    ratio = (dark - left * bright) / left  # of the lamp's light to that from around
    if ratio < 0.1:
        return None
    share = ratio / (1 + ratio)
    lit = share + (1 - share) * bright
    return replace(scene, lamp_share=float(share), white=float(scene.white / lit))


def _hidden(scene: Scene, rng: np.random.Generator, index: int) -> Scene:
    """With `HIDDEN_PART` of the marker behind a finger, a box or the image's border."""
    by = ("finger", "box", "border")[index % 3]
    # A lamp beside the camera, so that the shadow lies mostly behind what casts it.
    lamp = scene.eye() / np.linalg.norm(scene.eye()) + 0.4 * rng.standard_normal(3)
    lamp[2] = max(lamp[2], 0.3)
    distance = np.linalg.norm(scene.light_m)
    scene = replace(scene, light_m=lamp / np.linalg.norm(lamp) * distance)
    hide = _past_the_border if by == "border" else _covered
    scene, part = hide(scene, rng, by)
    return replace(scene, truth=scene.truth | {"hidden": {"by": by, "part": part}})


def _past_the_border(scene: Scene, rng: np.random.Generator, _: str) -> tuple[Scene, float]:
    """Cropped so that the marker is partly outside, and the part that is."""
    axis, far = rng.integers(2), rng.integers(2)
    at = scene.project(on_paper(60, SIZE_M))[:, axis]
    crop = list(scene.crop_px)
    cut = np.quantile(at, 1 - HIDDEN_PART if far else HIDDEN_PART)
    crop[axis] += int(np.round(cut + 0.5 - far * crop[2 + axis]))
    scene = replace(scene, crop_px=tuple(crop))
    at = scene.project(on_paper(60, SIZE_M))[:, axis]
    return scene, float(np.mean((at < -0.5) | (at > crop[2 + axis] - 0.5)))


def _covered(scene: Scene, rng: np.random.Generator, by: str) -> tuple[Scene, float]:
    """With a thing pushed over the marker from aside, and the part that it hides."""
    angle, aside_m = rng.uniform(0, 2 * np.pi), SIZE_M * rng.uniform(-0.25, 0.25)
    n = np.array([np.cos(angle), np.sin(angle), 0])
    R = np.stack([np.cross([0, 0, 1.0], n), [0, 0, 1.0], n], axis=1)
    if by == "finger":
        thickness = rng.uniform(0.19, 0.3)
        half = SIZE_M * np.array([thickness, thickness, 2.0])
        reach, coated = half[2] + half[0], np.full((1, 1), rng.uniform(0.3, 0.55))
    else:
        half = SIZE_M * np.array([rng.uniform(0.5, 1), rng.uniform(0.05, 0.3), rng.uniform(0.3, 1)])
        reach, coated = half[2], coat(rng)

    def pushed(depth_m: float) -> Thing:
        place = (SIZE_M - depth_m + reach) * n + aside_m * R[:, 0]
        kind = "capsule" if by == "finger" else "box"
        return Thing(kind, R, place + np.array([0, 0, half[1] + 0.002]), half, coated)

    def part(depth_m: float) -> float:
        return float(np.mean(pushed(depth_m).hides(scene.eye(), on_paper(60, SIZE_M))))

    low, high = 0.0, 2 * SIZE_M
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if part(middle) < HIDDEN_PART else (low, middle)
    return replace(scene, things=(pushed(high),)), part(high)


def _fits(scene: Scene) -> bool:
    """Whether the marker is in the picture, and hidden or shaded as its set wants."""
    if (eye := scene.eye())[2] < 2 * SIZE_M:
        return False
    hidden = scene.truth.get("hidden")
    if hidden:
        return abs(hidden["part"] - HIDDEN_PART) < 0.05
    if any(np.any(thing.hides(eye, on_paper(9, 1.3 * SIZE_M))) for thing in scene.things):
        return False
    corners = scene.project(CORNERS_M)
    return bool(np.all(corners > 2) and np.all(corners < np.array(scene.crop_px[2:]) - 3))
