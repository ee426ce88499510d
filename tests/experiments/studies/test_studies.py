"""Studies: the config, the cutting of the grid, the store and the summary."""

import errno
import json
import os
import re
import time
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.cli import main
from jaxnav.errors import BadInput
from jaxnav.experiments.studies import store as store_module
from jaxnav.experiments.studies.parameters import Parameter
from jaxnav.experiments.studies.running import (
    local_cluster,
    remote_cluster,
    run_here,
    run_on_cluster,
)
from jaxnav.experiments.studies.store import BoxLayout, StudyStore, open_store
from jaxnav.experiments.studies.study import (
    Cell,
    Config,
    Progress,
    Rate,
    Schema,
    Study,
    Variable,
    nobody,
)
from jaxnav.experiments.studies.summary import order_statistic, summarise
from jaxnav.files.writing import sole_writer
from jaxnav.sim.statistics import wilson_interval

PARAMETERS = {
    "a_m": Parameter("a length", "m", 1.0, low=0.0, open_low=True),
    "b": Parameter("a count", "", 2, low=1, high=9, whole=True),
    "c_deg": Parameter("an angle", "deg", 0.0, words=("random",)),
    "selector": Parameter("a word", "", "x", choices=("x", "y", "z")),
}
LOG = {"from": 1, "to": 2, "count": 3, "scale": "log"}
OUTCOMES = ("right", "flipped", "invalid")
SCHEMA = Schema(
    kind="fake",
    parameters=PARAMETERS,
    variables={
        "outcome": Variable("", dtype="int8", of_selector=True, outcomes=OUTCOMES),
        "error_m": Variable("", "m", of_selector=True, among=("right", "flipped")),
        "steps": Variable("", dtype="int16"),
        "p": Variable("", of_selector=True),
    },
    rates={"flip_rate": Rate("", "outcome", ("flipped",), ("right", "flipped"))},
    box_trials=64,
    inner=("selector",),
    predicted="p",
)


class Fake(Study):
    """Numbers that are a function of cell and trial, and a lane that is not finite."""

    schema = SCHEMA
    slow_s = 0.0
    deadly = False

    def run(
        self, cells: Sequence[Cell], trials: range, progress: Progress = nobody
    ) -> dict[str, np.ndarray]:
        if self.deadly:
            os._exit(1)
        time.sleep(self.slow_s)
        selectors = self.config.axes.get("selector", [self.config.fixed.get("selector")])
        shape = (len(cells), len(selectors), len(trials))
        draws = np.empty(shape)
        for i, cell in enumerate(cells):
            for j, trial in enumerate(trials):
                seed = [self.config.seed, int(float(cell["a_m"]) * 1000), int(cell["b"]), trial]
                draws[i, :, j] = np.random.default_rng(seed).random(len(selectors))
        outcome = np.where(draws < 0.3, 1, 0)
        outcome[draws > 0.95] = 2
        found = {
            "outcome": outcome.astype(np.int8),
            "error_m": np.where(outcome == 2, np.nan, draws * 10 - 5).astype(np.float32),
            "steps": (draws[:, 0] * 10).astype(np.int16),
            "p": draws.astype(np.float32),
        }
        if "selector" not in self.config.axes:
            return {name: v[:, 0] if v.ndim == 3 else v for name, v in found.items()}
        return found


def stored(path: Path, study: Study | None = None) -> StudyStore:
    """The store of a study that has been run."""
    study = study or Fake(config())
    store = open_store(path, study)
    run_here(study, store)
    return store


def config(**changes: object) -> Config:
    data = {"trials": 20, "axes": {"a_m": [1, 2, 3], "selector": ["x", "z"], "b": [2, 5]}}
    return Config.parse(SCHEMA, data | changes, "study.yaml")


@pytest.mark.parametrize(
    ("changes", "where", "what"),
    [
        ({"axes": {}}, "axes", "empty grid"),
        ({"axes": {"a_m": []}}, "axes.a_m", "empty axis"),
        ({"axes": {"a_mm": [1]}}, "axes.a_mm", "unknown axis of a study of kind fake"),
        ({"axes": {"a_m": [1, -1]}}, "axes.a_m[1]", "must be > 0, got -1"),
        ({"axes": {"a_m": [1, 1]}}, "axes.a_m[1]", "repeats"),
        ({"axes": {"a_m": [1, ".nan"]}}, "axes.a_m[1]", "must be a number"),
        ({"axes": {"a_m": [float("nan")]}}, "axes.a_m[0]", "must be finite"),
        ({"axes": {"a_m": {"from": 1, "to": 2}}}, "axes.a_m.count", "must be a number"),
        ({"axes": {"a_m": {"from": 2, "to": 1, "count": 2}}}, "axes.a_m.to", "larger than"),
        ({"axes": {"a_m": {"from": 1, "to": 2, "count": 0}}}, "axes.a_m.count", "from 1 to"),
        ({"axes": {"a_m": LOG | {"from": 0}}}, "axes.a_m.from", "> 0"),
        ({"axes": {"a_m": LOG | {"scales": 1}}}, "axes.a_m.scales", "unknown key"),
        ({"axes": {"a_m": 3}}, "axes.a_m", "must be a list"),
        ({"axes": {"b": [2.5]}}, "axes.b[0]", "whole number"),
        ({"axes": {"b": [True]}}, "axes.b[0]", "must be a number"),
        ({"axes": {"c_deg": ["random"]}}, "axes.c_deg[0]", "must be a number to lie on an axis"),
        ({"axes": {"selector": ["w"]}}, "axes.selector[0]", "unknown 'w': expected x, y, z"),
        ({"fixed": {"a_m": 1}}, "fixed.a_m", "is an axis as well"),
        ({"fixed": {"c_deg": "often"}}, "fixed.c_deg", "must be a number or random"),
        ({"fixed": {"q": 1}}, "fixed.q", "unknown parameter"),
        ({"fixed": [1]}, "fixed", "must be a mapping"),
        ({"trials": 0}, "trials", "from 1 to"),
        ({"trials": None}, "trials", "missing"),
        ({"seed": -1}, "seed", "from 0 to"),
        ({"precision": "half"}, "precision", "float32 or float64"),
        ({"axis": {}}, "axis", "unknown key: expected trials"),
    ],
)  # fmt: skip
def test_a_bad_config_names_the_key(changes: dict, where: str, what: str) -> None:
    with pytest.raises(BadInput) as caught:
        config(**changes)
    assert str(caught.value).startswith(f"study.yaml: {where}: ")
    assert what in str(caught.value)


def test_a_config_is_complete_and_reads_back() -> None:
    some = config(
        axes={"a_m": {"from": 0.1, "to": 0.5, "count": 5}}, fixed={"c_deg": "random"}, seed=4
    )
    assert some.axes == {"a_m": [0.1, 0.2, 0.3, 0.4, 0.5]}
    assert some.fixed == {"b": 2, "c_deg": "random", "selector": "x"}
    plain = json.loads(json.dumps(some.to_dict()))
    assert plain.pop("kind") == "fake"
    files = plain.pop("files")
    assert Config.parse(SCHEMA, plain, "store", files) == some
    spaced = config(axes={"a_m": {"from": 0.1, "to": 10, "count": 3, "scale": "log"}})
    assert spaced.axes == {"a_m": [0.1, 1.0, 10.0]}


@given(st.lists(st.integers(1, 6), min_size=1, max_size=4), st.integers(1, 50))
def test_every_trial_lies_in_one_box(shape: list[int], most: int) -> None:
    layout = BoxLayout.from_shape(shape, most)
    seen = np.zeros(shape, int)
    for box in np.ndindex(*layout.counts):
        region = layout.region(box)
        seen[region] += 1
        assert layout.size(box) == np.prod([s.stop - s.start for s in region]) <= most
        cells = list(layout.cells(box))
        assert len(cells) * (region[-1].stop - region[-1].start) == layout.size(box)
        assert all(seen[cell].size for cell in cells)
    assert np.all(seen == 1)


def test_a_killed_study_goes_on_to_the_same_result_whatever_the_boxes(tmp_path: Path) -> None:
    whole = stored(tmp_path / "whole.zarr")
    study = Fake(config())
    parts = open_store(tmp_path / "parts.zarr", study, 7)

    class KilledError(Exception):
        pass

    def stop(done: int) -> None:
        if parts.count_done() > 40:
            raise KilledError

    with pytest.raises(KilledError):
        run_here(study, parts, stop)
    held = parts.count_done()
    assert 40 < held < 120
    again = open_store(parts.path, study, 1000)  # keeps its own boxes
    counted: list[int] = []
    run_here(study, again, counted.append)
    assert held + sum(counted) == 120 == again.count_done()
    xr.testing.assert_identical(whole.dataset(), parts.dataset())


def test_the_dataset_is_labelled(tmp_path: Path) -> None:
    stored(tmp_path / "s.zarr")
    found = xr.open_zarr(tmp_path / "s.zarr", consolidated=False, chunks=None)
    assert found["error_m"].dims == ("a_m", "b", "selector", "trial")
    assert found["steps"].dims == ("a_m", "b", "trial")
    assert found["a_m"].attrs == {"units": "m", "long_name": "a length"}
    assert list(found["selector"].values) == ["x", "z"]
    assert found["outcome"].attrs["flag_meanings"] == "right flipped invalid"
    assert json.loads(found.attrs["config"])["seed"] == 0
    assert json.loads(found.attrs["versions"])["jaxnav"]
    value = Fake(config()).run([{"a_m": 2.0, "b": 5}], range(20))["error_m"][0, 1, 7]
    assert found["error_m"].sel(a_m=2, b=5, selector="z", trial=7) == value


def test_a_store_of_another_study_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    open_store(path, Fake(config()))
    axes = config().axes
    fewer, turned = {**axes, "a_m": [1, 2]}, dict(reversed(axes.items()))
    open_store(tmp_path / "rig.zarr", Fake(replace(config(), files={"rig": "a"})))
    for other, name, said in (
        (config(axes=fewer), "s.zarr", "axes.a_m is [1.0, 2.0] here and [1.0, 2.0, 3.0] there"),
        (config(seed=1), "s.zarr", "seed is 1 here and 0 there"),
        (config(axes=turned), "s.zarr", "axes are in another order"),
        (replace(config(), files={"rig": "b"}), "rig.zarr", "files.rig is b here and a there"),
    ):
        with pytest.raises(BadInput, match=re.escape(said)):
            open_store(tmp_path / name, Fake(other))


def test_a_store_of_other_versions_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_store(tmp_path / "s.zarr", Fake(config()))
    real = store_module.versions()
    monkeypatch.setattr(store_module, "versions", lambda: real | {"jaxlib": "0.0"})
    with pytest.raises(BadInput, match=r"jaxlib is 0.0 here and .* there"):
        open_store(tmp_path / "s.zarr", Fake(config()))


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "full", tmp_path / "file"):
        with pytest.raises(BadInput, match="is not a store of jaxnav study"):
            open_store(path, Fake(config()))
    assert (tmp_path / "full" / "letter.txt").read_text() == "dear"
    with pytest.raises(BadInput, match="doesn't exist"):
        StudyStore(tmp_path / "nowhere")
    with pytest.raises(BadInput, match="can't be made"):
        open_store(tmp_path / "file" / "s.zarr", Fake(config()))


def test_a_full_disk_is_one_line_and_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import zarr.storage._local as local

    study = Fake(config())
    store = open_store(tmp_path / "s.zarr", study, 20)
    put, written = local._put, []

    def filling(path: Path, *rest: object, **more: object) -> object:
        if len(written) >= 11:  # in the midst of the third box
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(path)
        return put(path, *rest, **more)

    monkeypatch.setattr(local, "_put", filling)
    with pytest.raises(BadInput, match=r"s.zarr: can't be written: no space left on device"):
        run_here(study, store)
    monkeypatch.undo()
    assert store.count_done() == 40
    assert np.sum(store.dataset()["outcome"].values != 127) >= 80
    assert stored(store.path).count_done() == 120


Summed = tuple[xr.Dataset, xr.Dataset, Config]


@pytest.fixture(scope="module")
def summed(tmp_path_factory: pytest.TempPathFactory) -> Summed:
    study = Fake(config(trials=300))
    store = stored(tmp_path_factory.mktemp("summed") / "s.zarr", study)
    trials = store.dataset()
    return trials, summarise(trials, study.config, store.layout), study.config


def test_a_summary_is_that_of_the_trials(summed: Summed) -> None:
    trials, summary, _ = summed
    at = {"a_m": 2.0, "b": 5, "selector": "z"}
    outcome, error = trials["outcome"].sel(at).values, trials["error_m"].sel(at).values
    counts = summary["outcome_count"].sel(at)
    assert [int(counts.sel(outcome=name)) for name in OUTCOMES] == list(np.bincount(outcome))
    rate = summary["flip_rate"].sel(at).item()
    told = outcome != 2
    assert rate == pytest.approx(np.mean(outcome[told] == 1))
    ends = wilson_interval(np.array(rate), np.array(told.sum()))
    assert (summary["flip_rate_low"].sel(at), summary["flip_rate_high"].sel(at)) == ends
    finite = np.sort(error[told])
    assert summary["error_m_counted"].sel(at) == told.sum()
    assert summary["error_m_median"].sel(at) == finite[told.sum() // 2]
    assert summary["error_m_p95"].sel(at) == finite[int(0.95 * told.sum())]
    assert summary["error_m_mean"].sel(at) == pytest.approx(finite.mean(dtype=float), rel=1e-6)
    assert summary["reliability_count"].sum("bin").sel(selector="z") == np.sum(
        trials["outcome"].sel(selector="z").values != 2
    )


def test_a_summary_does_not_depend_on_the_boxes(summed: Summed) -> None:
    trials, summary, whole = summed
    cut = summarise(trials, whole, BoxLayout((3, 2, 300), (1, 1, 77)))
    xr.testing.assert_allclose(cut, summary, rtol=1e-12)


@settings(max_examples=50)
@given(
    st.lists(
        st.one_of(
            st.floats(width=32, allow_nan=False, allow_infinity=False), st.just(float("nan"))
        ),
        min_size=1,
        max_size=30,
    ),
    st.sampled_from([0.05, 0.5, 0.95]),
    st.integers(1, 4),
)
def test_an_order_statistic_in_passes_is_exact(
    numbers: list[float], share: float, pieces: int
) -> None:
    row = np.asarray(numbers, np.float32)[None]
    counted = np.sum(np.isfinite(row), axis=1)

    def blocks() -> Iterator[np.ndarray]:
        yield from np.array_split(row, pieces + 1, axis=1)

    found = order_statistic(blocks, share, counted, pieces + 1)
    whole = order_statistic(lambda: iter([row]), share, counted, 1)
    np.testing.assert_array_equal(found, whole)
    if counted[0]:
        finite = np.sort(row[np.isfinite(row)])
        assert whole[0] == finite[min(int(share * len(finite)), len(finite) - 1)]
    else:
        assert np.isnan(whole[0])


@pytest.fixture
def by_value() -> Iterator[None]:
    """Workers know nothing of this module: its classes travel whole."""
    import sys

    import cloudpickle

    module = sys.modules[__name__]
    cloudpickle.register_pickle_by_value(module)
    yield
    cloudpickle.unregister_pickle_by_value(module)


@pytest.mark.long
def test_a_cluster_that_loses_a_worker_finds_the_same(tmp_path: Path, by_value: None) -> None:
    import psutil

    here = stored(tmp_path / "here.zarr")
    marked = tmp_path / "marked"
    study = Fake(config())
    study.slow_s = 0.1
    there = open_store(tmp_path / "there.zarr", study, 5)
    killed: list[int] = []
    with local_cluster(2) as owner, remote_cluster(owner.scheduler.address, marked.touch) as client:

        def kill_one(done: int) -> None:
            if not killed:
                workers = client.run(os.getpid)
                killed.append(next(iter(workers.values())))
                psutil.Process(killed[0]).kill()

        run_on_cluster(study, there, client, "--workers", kill_one)
    assert killed
    assert marked.exists()  # every worker was prepared
    xr.testing.assert_identical(here.dataset(), there.dataset())


def test_workers_that_die_for_good_are_one_line(tmp_path: Path, by_value: None) -> None:
    import dask
    import distributed  # noqa: F401 - before `set`, whose end would take all its defaults away

    study = Fake(config())
    study.deadly = True
    store = open_store(tmp_path / "s.zarr", study, 60)
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        local_cluster(1) as client,
        pytest.raises(BadInput, match="--workers: a box killed one worker after the other"),
    ):
        run_on_cluster(study, store, client, "--workers")
    assert store.count_done() == 0


@pytest.mark.long
def test_a_scheduler_that_goes_is_one_line(tmp_path: Path, by_value: None) -> None:
    study = Fake(config())
    study.slow_s = 0.2
    store = open_store(tmp_path / "s.zarr", study, 5)

    with (
        local_cluster(1) as owner,
        remote_cluster(owner.scheduler.address, lambda: None, timeout_s=2.0) as client,
        pytest.raises(BadInput, match=r"--scheduler: the scheduler is gone; what is done is kept"),
    ):
        run_on_cluster(study, store, client, "--scheduler", lambda done: owner.cluster.close())
    assert 0 < store.count_done() < 120


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["study", "ambiguity", "nowhere.yaml"], "nowhere.yaml: can't be read"),
        (["study", "ambiguity", "STUDY", "--workers", "0"], "--workers: must be at least 1"),
        (["study", "ambiguity", "STUDY", "--chunk-trials", "0"], "--chunk-trials: must be"),
        (["study", "ambiguity", "STUDY", "--scheduler", "nonsense"], "--scheduler: no Dask"),
        (["study", "drive", "STUDY"], "axes.view_angle_deg: unknown axis of a study of kind drive"),
        (["plot", "nowhere.zarr"], "nowhere.zarr: doesn't exist"),
    ],
)
def test_a_bad_command_is_one_line(
    args: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("jaxnav.commands.study.study.configure_jax", lambda float64: None)
    monkeypatch.chdir(tmp_path)
    Path("study.yaml").write_text("trials: 2\naxes:\n  view_angle_deg: [1]\n")
    code = main([word if word != "STUDY" else "study.yaml" for word in args])
    printed = capsys.readouterr()
    assert code == 2
    assert said in printed.err
    assert printed.err.count("\n") == 1


def test_a_second_process_at_one_store_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jaxnav.commands.study.study.configure_jax", lambda float64: None)
    monkeypatch.chdir(tmp_path)
    Path("study.yaml").write_text("trials: 2\naxes:\n  view_angle_deg: [1]\n")
    Path("out").mkdir()
    with sole_writer("out/study.zarr"):
        assert main(["study", "ambiguity", "study.yaml"]) == 2
    assert "out/study.zarr: is being written by another process\n" in capsys.readouterr().err
    assert not list(Path("out").iterdir())


def test_what_a_killed_process_has_left_of_a_new_store_is_swept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as killed:
        killed.setattr(Path, "rename", lambda path, to: None)
        killed.setattr(store_module.shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises(BadInput):  # it is not there after all
            open_store(tmp_path / "s[1].zarr", Fake(config()))
    (tmp_path / ".jaxnav-s1.zarr-x").mkdir()
    (tmp_path / ".jaxnav-else").mkdir()
    assert len(list(tmp_path.iterdir())) == 3
    store_module.sweep_unfinished(tmp_path / "s[1].zarr")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {".jaxnav-s1.zarr-x", ".jaxnav-else"}


@pytest.mark.long
def test_memory_does_not_grow_with_the_study(tmp_path: Path) -> None:
    class Many(Fake):
        """As many trials as one likes, at once."""

        def run(
            self, cells: Sequence[Cell], trials: range, progress: Progress = nobody
        ) -> dict[str, np.ndarray]:
            found = {}
            for name, variable in SCHEMA.variables.items():
                shape = (len(cells), 2, len(trials)) if variable.of_selector else None
                found[name] = np.zeros(shape or (len(cells), len(trials)), variable.dtype)
            return found

    def peak_bytes(trials: int) -> int:
        study = Many(config(trials=trials, axes={"a_m": [1, 2], "selector": ["x", "z"]}))
        store = open_store(tmp_path / f"{trials}.zarr", study, 5_000)
        tracemalloc.start()
        run_here(study, store)
        summarise(store.dataset(), study.config, store.layout)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return peak

    few, many = peak_bytes(10_000), peak_bytes(80_000)
    assert many < 1.3 * few
