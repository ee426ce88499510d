"""`jaxnav calibrate convert`: round trips, number by number, and the effects of damage."""

import json
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.markers import MarkerEntry, markers_text
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, rig_text
from tests.helpers import seed_texts
from tests.helpers.conversions import (
    HELD,
    KALIBR,
    LAYOUT,
    PHOTONVISION,
    QCAR,
    ROS,
    a_camera,
    cameras_in,
    convert,
    markers_in,
    same_lens,
    written,
)
from tests.helpers.mutations import Changed, restructured
from tests.helpers.yaml_numbers import dumped

drawn = settings(derandomize=True, database=None, suppress_health_check=list(HealthCheck))


def assert_same_place(a: CameraEntry, b: CameraEntry) -> None:
    """Bit for bit; a matrix and a quaternion as near as they come."""
    T_a, T_b = a.T_camera_vehicle, b.T_camera_vehicle
    if type(T_a) is type(T_b):
        assert T_a == T_b
    M_a, M_b = poses.matrix_as_read(T_a), poses.matrix_as_read(T_b)
    np.testing.assert_array_equal(M_a[:3, 3], M_b[:3, 3])
    np.testing.assert_allclose(M_a, M_b, rtol=0, atol=1e-15)


@pytest.mark.parametrize(("to", "lens"), HELD)
def test_a_camera_comes_back_bit_for_bit(to, lens):
    suffix = ".json" if to == "photonvision" else ".yaml"

    @settings(drawn, max_examples=15)
    @given(a_camera(lens))
    def check(camera: CameraEntry) -> None:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            source = written(folder, "rig.yaml", rig_text([camera]))
            there = convert(source, to, folder / f"front{suffix}")
            assert same_lens(cameras_in(there)[0], camera)
            position_m, back = (0.1, -0.2, 0.3), folder / "back.yaml"
            convert(there, "jaxnav", back, position_m=position_m, yaw_deg=90.0)
            assert same_lens(cameras_in(back)[0], camera)
            again = convert(back, to, folder / f"again{suffix}", camera_name="front")
            assert again.read_text() == there.read_text()

    check()


@settings(drawn, max_examples=20)
@given(st.data())
def test_a_rig_goes_through_a_camchain_bit_for_bit(data):
    lenses = [lens for lens in LENS_COEFFICIENTS if lens not in ("rational", "thin_prism")]
    lenses = data.draw(st.lists(st.sampled_from(lenses), min_size=1, max_size=3))
    rig = [data.draw(a_camera(lens, f"c/{n}", k3=False)) for n, lens in enumerate(lenses)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = written(folder, "rig.yaml", rig_text(rig))
        chain = convert(source, "kalibr", folder / "chain.yaml")
        back = convert(chain, "jaxnav", folder / "back.yaml")
        for camera, again in zip(rig, cameras_in(back), strict=True):
            assert same_lens(camera, again)
            assert_same_place(camera, again)
        # What is a matrix by now stays, to the last letter.
        assert convert(back, "kalibr", folder / "2.yaml").read_text() == chain.read_text()
        stored = yaml.safe_load(chain.read_text())
        for n in range(1, len(rig)):
            T_before, T = (np.array(stored[f"cam{m}"]["T_cam_imu"]) for m in (n - 1, n))
            chained = np.array(stored[f"cam{n}"]["T_cn_cnm1"]) @ T_before
            rounding = 1e-14 * max(np.abs(T_before).max(), np.abs(T).max())
            np.testing.assert_allclose(chained, T, rtol=0, atol=rounding)


@settings(drawn, max_examples=20)
@given(st.data())
def test_a_map_goes_through_a_field_layout(data):
    size_m = data.draw(st.floats(1e-3, 10))
    markers = []
    for marker_id in data.draw(st.lists(st.integers(0, 29), min_size=1, max_size=4, unique=True)):
        placed = data.draw(a_camera("none")).T_camera_vehicle
        markers.append(
            MarkerEntry.model_construct(
                id=marker_id, family="tag16h5", size_m=size_m, T_world_marker=placed
            )
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = written(folder, "markers.yaml", markers_text(markers))
        layout = convert(source, "wpilib", folder / "l.json", field_size_m=(16.541, 8.211))
        assert json.loads(layout.read_text())["field"] == {"length": 16.541, "width": 8.211}
        told = {"marker_size_m": size_m, "family": "tag16h5"}
        back = markers_in(convert(layout, "jaxnav", folder / "back.yaml", **told))
    for marker, again in zip(markers, back, strict=True):
        assert (again.id, again.family, again.size_m) == (marker.id, marker.family, marker.size_m)
        T, T_again = (poses.matrix_as_read(m.T_world_marker) for m in (marker, again))
        np.testing.assert_array_equal(T_again[:3, 3], T[:3, 3])
        np.testing.assert_allclose(T_again, T, rtol=0, atol=2e-15)


# --- damage --------------------------------------------------------------------------

EXAMPLES = int(os.environ.get("JAXNAV_FUZZ", "8"))
SEEDS = {
    "rig.yaml": (QCAR / "rig.yaml").read_text(),
    "chain.yaml": KALIBR,
    "ros.yaml": ROS,
    "opencv.yaml": seed_texts.OPENCV,
    "photonvision.json": json.dumps(PHOTONVISION),
    "map.yaml": (QCAR / "markers.yaml").read_text(),
    "layout.json": json.dumps(LAYOUT),
}


def tried(source: Path, to: str, out: Path) -> None:
    """Converted to something that reads as the same, or one line."""
    place = {"position_m": (0.1, 0.2, 0.3)} if to == "jaxnav" else {}
    for flags in (place, {}):
        try:
            convert(source, to, out, **flags)
        except BadInput as bad:
            assert "\n" not in str(bad)  # noqa: PT017
            assert not out.exists()
            continue
        made = sorted(out.iterdir()) if out.is_dir() else [out]
        if "markers" in read_mapping(made[0]) or "tags" in read_mapping(made[0]):
            return
        given = cameras_in(source)
        read = [camera for path in made for camera in cameras_in(path)]
        figures = [(c.focal_px, c.center_px, c.image_size_px, sum(c.distortion)) for c in read]
        expected = [(c.focal_px, c.center_px, c.image_size_px, sum(c.distortion)) for c in given]
        assert sorted(figures) == sorted(expected)
        return


@pytest.mark.parametrize("name", SEEDS)
def test_whatever_is_changed_is_carried_over_or_one_line(name, tmp_path, capsys):
    whole = read_mapping(written(tmp_path, name, SEEDS[name]))

    @settings(drawn, max_examples=2 * EXAMPLES)
    @given(restructured(whole))
    def check(changed: Changed) -> None:
        with tempfile.TemporaryDirectory() as folder:
            dump = json.dumps if name.endswith(".json") else dumped
            source = written(Path(folder), name, dump(changed.data))
            for to in ("jaxnav", "kalibr", "ros", "opencv", "photonvision", "wpilib"):
                many = to in ("jaxnav", "kalibr", "wpilib")
                suffix = ".json" if to == "wpilib" else ".yaml"
                tried(source, to, Path(folder) / (f"{to}_out{suffix}" if many else f"{to}_out"))
        capsys.readouterr()

    check()
