"""The compiled step against the jitted one: the same numbers, and nothing compiled twice."""

import os
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.navigator import Navigator
from jaxnav.drive.compiled_step import compiled_step, strip_static
from jaxnav.files import executables
from jaxnav.recordings import drive_setup
from tests import worlds

SEEN_FROM = (0.1, -0.6, np.pi / 2)


class OnesOwn(LowestReprojection):
    """A selector that jaxnav knows nothing of."""


def navigator(selector: LowestReprojection | None = None) -> Navigator:
    rig = worlds.qcar_rig()
    return Navigator(rig, worlds.paper_markers(), selector=selector or LowestReprojection())


def never(*_):
    raise AssertionError("must not be called")


def damaged(raw: bytes) -> list[bytes]:
    """Cut, or with one bit flipped; half of it is the last."""
    places = np.random.default_rng(0).integers(0, len(raw), 20)
    flipped = [raw[:k] + bytes([raw[k] ^ 1]) + raw[k + 1 :] for k in (0, 31, 32, *places)]
    return [*flipped, b"", raw[:31], raw[:32], raw + b"\0", raw[: len(raw) // 2]]


def test_it_is_the_step_and_is_compiled_once(tmp_path, monkeypatch):
    nav = navigator()
    moved = eqx.tree_at(lambda n: n.rig.cameras.focal_px, nav, nav.rig.cameras.focal_px + 3.0)
    obs = worlds.observe(nav.rig, nav.markers, worlds.planar(*SEEN_FROM))
    jitted = jax.jit(lambda nav, state, obs: nav.step(state, obs))

    def is_kept(function, nav):
        name, *_ = executables._asked(function, (strip_static(nav), nav.init(), obs), {})
        return (tmp_path / name).is_file()

    assert not is_kept(Navigator.step, nav)
    first = compiled_step(nav, tmp_path)
    state, _ = first(nav.init(), obs)
    assert is_kept(Navigator.step, nav)
    assert is_kept(Navigator.step, moved)
    assert not is_kept(Navigator.coast, nav)
    (file,) = tmp_path.iterdir()
    monkeypatch.setattr(executables, "_compiled", never)
    later, recalibrated = compiled_step(nav, tmp_path), compiled_step(moved, tmp_path)
    for step, which in ((first, nav), (later, nav), (recalibrated, moved)):
        for before in (nav.init(), state):  # the second call of each takes another way
            jax.tree.map(
                np.testing.assert_array_equal, step(before, obs), jitted(which, before, obs)
            )
    assert later(state, obs)[1].located

    monkeypatch.undo()
    for raw in damaged(file.read_bytes()):
        file.write_bytes(raw)
        with monkeypatch.context() as unopened:
            unopened.setattr(executables.pickle, "loads", never)
            assert executables._loaded(tmp_path, file.name, []) is None
    repaired, _ = compiled_step(nav, tmp_path)(nav.init(), obs)
    jax.tree.map(np.testing.assert_array_equal, repaired, state)
    monkeypatch.setattr(executables, "_compiled", never)
    compiled_step(nav, tmp_path)(nav.init(), obs)


def test_a_file_is_for_one_structure_shape_and_source(monkeypatch, tmp_path):
    def file(nav, shape=()):
        return executables._file(str(jax.tree.structure(nav)), [jnp.zeros(shape)])

    nav = navigator()
    assert file(nav) == file(eqx.tree_at(lambda n: n.corner_sigma_px, nav, 2.0))
    with jax.enable_x64(False):
        in_float32 = file(nav)
    shorter = Navigator(nav.rig, nav.markers, selector=LowestReprojection(), max_lm_steps=3)
    others = [file(shorter), file(nav, (2,)), in_float32]
    monkeypatch.setenv("XLA_FLAGS", "--another")
    others.append(file(nav))
    monkeypatch.undo()
    monkeypatch.setattr(executables, "PACKAGE", tmp_path)
    for folder in (tmp_path, tmp_path / "detection", tmp_path / "drive"):
        folder.mkdir(exist_ok=True)
        (folder / "one.py").write_text("# changed")
        executables.sources_digest.cache_clear()  # as in another process
        others.append(file(nav))
    monkeypatch.undo()
    assert len({file(nav), *others}) == 8


def test_the_digest_is_of_all_that_a_program_or_a_drive_depends_on(tmp_path):
    package = tmp_path / "jaxnav"
    shutil.copytree(executables.PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))

    def digests():
        executables.sources_digest.cache_clear()
        without = executables._WITHOUT, drive_setup._WITHOUT
        return [executables.sources_digest(package, folders) for folders in without]

    for name, of_program, of_drive in [
        ("core/pose/refine.py", True, True),
        ("core/navigator.py", True, True),
        ("core/linalg/small_matrices.py", True, True),
        ("vehicles/sim.py", True, False),
        ("vehicles/conformance/matrix.py", False, False),
        ("recordings/records.py", True, True),
        ("experiments/tuning/driving.py", True, False),
        ("recordings/other/tagslam.py", True, False),
        ("commands/drive/run.py", False, False),
    ]:
        before = digests()
        with (package / name).open("a") as source:
            source.write("# changed\n")
        changed = [a != b for a, b in zip(before, digests(), strict=True)]
        assert changed == [of_program, of_drive], name
    executables.sources_digest.cache_clear()
    for folder in (*executables._WITHOUT, *drive_setup._WITHOUT):
        assert (package / folder).is_dir(), folder


def test_without_a_folder_or_with_foreign_parts_nothing_is_kept(monkeypatch, tmp_path):
    """Whose source is not known can't be told apart from another of its name."""
    monkeypatch.setattr(executables, "_compiled", never)
    obs = worlds.observe(worlds.qcar_rig(), worlds.paper_markers(), worlds.planar(*SEEN_FROM))
    for nav, folder in ((navigator(), None), (navigator(OnesOwn()), tmp_path)):
        _, out = compiled_step(nav, folder)(nav.init(), obs)
        assert out.located
    assert not list(tmp_path.iterdir())


def test_old_files_go_and_a_full_disk_is_no_failure(tmp_path, monkeypatch):
    monkeypatch.setattr(executables, "_KEPT", 3)
    folder = tmp_path / "steps"
    names = [f"{number:064x}.step" for number in range(6)]
    for name in names[:2]:
        executables._keep(folder, name, b"")
    (folder / "bracket.step").write_text("a drawing of somebody's")
    for name in names[2:5]:
        executables._keep(folder, name, b"")
    assert {path.name for path in folder.iterdir()} == {*names[2:5], "bracket.step"}

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    executables._keep(folder, names[5], b"5")
    assert {path.name for path in folder.iterdir()} == {*names[2:5], "bracket.step"}


def test_of_a_folder_that_is_not_this_users_nothing_is_loaded(tmp_path, monkeypatch):
    folder = tmp_path / "steps"
    told = jnp.zeros(3), jnp.ones(3)

    def both(one, other):
        return one + other

    first = executables.program(both, told, folder)[0](list(told))
    (file,) = folder.iterdir()
    assert executables._loaded(folder, file.name, list(told)) is not None
    folder.chmod(0o777)
    assert executables._loaded(folder, file.name, list(told)) is None
    was = file.read_bytes()
    monkeypatch.setattr(executables.pickle, "loads", never)
    again = executables.program(both, told, folder)[0](list(told))
    np.testing.assert_array_equal(first[0], again[0])
    assert file.read_bytes() == was
    assert list(folder.iterdir()) == [file]


def test_a_kept_function_is_the_jitted_one_and_is_traced_once(tmp_path):
    traces = []

    def moved(camera, points):
        """Of other shapes, another program."""
        traces.append(points.shape)
        return camera.project(points) + 1.0, {"none": None}

    camera = worlds.qcar_rig().camera(0)
    points = [np.random.default_rng(0).random((n, 3)) + 0.5 for n in (4, 7, 4)]
    wanted = [jax.jit(moved)(camera, some) for some in points]
    traces.clear()
    executables.keep_in(tmp_path)
    try:
        for start in range(2):  # as another process would
            ours = executables.kept(moved)
            for some, same in zip(points, wanted, strict=True):
                jax.tree.map(np.testing.assert_array_equal, ours(camera, some), same)
            assert traces == [(4, 3), (7, 3)], start
        assert len(list(tmp_path.iterdir())) == 2
        slope = jax.jacobian(lambda some: ours(camera, some)[0])(points[0])  # of tracers: jitted
        assert np.isfinite(slope).all()
        assert ours.__doc__ == moved.__doc__
        executables.kept(jnp.linalg.inv)(np.eye(3))  # LAPACK's functions are not kept
        assert len(list(tmp_path.iterdir())) == 2
    finally:
        executables.keep_in(None)
