"""Set strict numerics for every test: warnings raise, ranks never promote implicitly, annotations
are checked at every call, and float64 is the default."""

import functools
import gc
import os
import platform
import signal
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import jax.numpy as jnp
import jaxlie
import pytest
from jaxtyping import install_import_hook

import tests.helpers.shapes
from tests.helpers import strangers

# No test is judged by the clock: machines are shared.
hypothesis.settings.register_profile("shared", deadline=None)
hypothesis.settings.load_profile("shared")
# As a terminal has it: a suite under `nohup` would have tests whose programs ignore it too.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
# The workers share the programs that they compile, and the next run finds them, in a fresh clone as
# well: what a program is called by is its text, the compiler and its flags. The thousands that are
# a single operation are kept too.
home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
kept = os.environ.get("JAXNAV_TEST_CACHE") or home / "jaxnav-tests"
jax.config.update("jax_compilation_cache_dir", str(kept))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# Nor does anybody look where in the sources an operation is from, children neither.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
jax.config.update("jax_traceback_in_locations_limit", 0)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Tracing makes millions of small objects that are not garbage; to look for it costs a tenth.
gc.set_threshold(1_000_000, 50, 100)
# The hook sees what is imported after it, so nothing of jaxnav may be imported above.
tests.helpers.shapes.wrap_arrays_alone()
install_import_hook("jaxnav.core", "beartype.beartype")
# Elsewhere arrays alone are checked: tests put stand-ins in the place of classes. Studies send
# objects to processes that lack the hook.
AROUND = [
    f"jaxnav.{name}"
    for name in (
        "calibrate", "detection", "drive", "experiments.tuning", "files", "recordings", "sim",
        "vehicles",
    )
]  # fmt: skip
install_import_hook(AROUND, "tests.helpers.shapes.check_arrays")

# Most of a run is compilation. LLVM's costly passes and wide registers win nothing on inputs as
# small as these, nor does a second thread beside a second worker. XLA reads this when the
# first array is made, and aborts on a flag that its version lacks.
if "XLA_FLAGS" not in os.environ:
    from jaxnav.files.configuration import FLAGS, known_flags

    quick = {
        "xla_backend_optimization_level": "0",
        "xla_llvm_disable_expensive_passes": "true",
        "xla_cpu_parallel_codegen_split_count": "1",
    }
    narrow = {"xla_cpu_max_isa": "SSE4_2"} if platform.machine() == "x86_64" else {}
    flags = known_flags(quick | FLAGS | narrow)
    os.environ["XLA_FLAGS"] = " ".join(f"--{name}={value}" for name, value in flags.items())


from tests.helpers import late  # noqa: E402  (it imports what the hooks see)

late.listen()

# A file is one worker's: what takes minutes must not come last.
LONG = """test_navigator test_hypotheses test_replay test_faults test_tune test_following test_demo
    test_tuning_driving test_rollout test_study_kinds test_studies test_examples test_twist_pilot
    test_strangers""".split()


def pytest_addoption(parser: pytest.Parser) -> None:
    told = "write the recorded drives of tests/data anew, for the diff to be reviewed"
    parser.addoption("--update-refs", action="store_true", help=told)


# Before `-m` leaves out what is long.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.suffix == ".ipynb":
            item.add_marker(pytest.mark.long)
    items.sort(key=lambda item: item.path.stem not in LONG)


@pytest.fixture(scope="module", autouse=True)
def let_compiled_code_go() -> Iterator[None]:
    """Every executable holds some memory maps, of which Linux allows a process 65 530: past them a
    whole run of the suite in two processes crashes inside jaxlib."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 20_000:
        jax.clear_caches()
        late.forget()


@pytest.fixture(autouse=True)
def nothing_is_compiled_while_somebody_waits() -> Iterator[None]:
    """See `tests/helpers/late.py`."""
    yield
    found = late.taken()
    assert not found, "\n".join(found)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The real recordings and photographs: $JAXNAV_DATA, else ../shared/data beside the project."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("JAXNAV_DATA") or default)
    if not path.is_dir():
        pytest.skip(f"no real data in {path}: set JAXNAV_DATA")
    return path


@pytest.fixture(scope="module", params=["crawler", pytest.param("slider", marks=pytest.mark.long)])
def stranger(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> strangers.Stranger:
    """Robots that are not the QCar, one after the other: a test that has this runs on each."""
    made: strangers.Stranger = getattr(strangers, request.param)(tmp_path_factory.mktemp("a lab"))
    return made


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.long)])
def precision(request: pytest.FixtureRequest) -> Iterator[jnp.dtype]:
    """The test runs once in each precision; JAX's default float is then this one. What vehicles
    run is float32, and tests without this run in float64."""
    with jax.enable_x64(request.param == "float64"):
        yield jnp.dtype(request.param)


def _may_promote(function):
    @functools.wraps(function)
    def within(*args, **kwargs):
        with jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return within


def _let_jaxlie_promote() -> None:
    """jaxlie adds (3, 3) to (batch, 3, 3): inside its methods, and only there, ranks may differ."""
    classes = {base for group in (jaxlie.SO3, jaxlie.SE3) for base in group.__mro__}
    for cls in classes:
        if not cls.__module__.startswith("jaxlie"):
            continue
        for name, attribute in list(vars(cls).items()):
            if name.startswith("_"):
                continue
            if isinstance(attribute, staticmethod | classmethod):
                setattr(cls, name, type(attribute)(_may_promote(attribute.__func__)))
            elif callable(attribute):
                setattr(cls, name, _may_promote(attribute))


_let_jaxlie_promote()
