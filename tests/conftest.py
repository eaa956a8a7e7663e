"""Fixtures shared by the tests; run from a checkout, installed or not."""

import contextlib
import functools
import gc
import importlib.metadata
import inspect
import itertools
import os
import re
import socket
import sys
import threading
import time
import types
import zlib
from pathlib import Path

# Threads of NumPy's matrix products wait in a loop for the next one, on a core that another worker needs. NumPy reads this on
# import.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "examples"
# What one test has compiled the next one need not, nor the next run: it is kept, and apart from what the user's own runs keep.
# Processes may share the folders: what JAX finds half-written it compiles again, and Warp puts a kernel there in one piece.
KEPT = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-dher-tests"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(KEPT / "xla"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # small programs take half of the time
os.environ.setdefault("WARP_CACHE_PATH", str(KEPT / "warp"))
# Python's tracebacks of each operation, which JAX writes into a program, take a tenth of the time of tracing and lowering.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")  # Trio's, which comes with selenium
MONTH = 30 * 24 * 60 * 60  # s


def _is_of_no_use(entry):
    """Whether a compiled program is a month old, and so most likely of code that has changed; or cut short, as a process that
    was killed leaves it: JAX would warn of that in each run, and never write it anew."""
    if time.time() - entry.stat().st_mtime > MONTH:
        return True
    content = entry.read_bytes()
    if content[:1] == b"x":  # zlib's, not Zstandard's
        try:
            zlib.decompress(content)
        except zlib.error:
            return True
    return not content


if "PYTEST_XDIST_WORKER" not in os.environ:
    for _entry in (KEPT / "xla").glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):  # another run was quicker
            if _is_of_no_use(_entry):
                _entry.unlink()
# Compiling takes most of the tests' time, and less than half of it without what makes programs fast. An unknown flag would end
# the process: jaxlib 0.11 has no fusion emitters to turn off.
_FLAGS = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
# These passes speed up loops, whose time is negligible here, and make compilation a quarter longer.
_PASSES = (
    *("while-loop-invariant-code-motion", "simplify-while-loops", "while-loop-constant-sinking", "simplify-conditional"),
    *("tree_reduction_rewriter", "reshape-mover", "gemv-rewriter"),
)
_FLAGS += f" --xla_cpu_parallel_codegen_split_count=1 --xla_disable_hlo_passes={','.join(_PASSES)}"
if importlib.metadata.version("jaxlib").startswith("0.10."):
    # The newer scheduler can lose a task of an MJX program, and the test then waits for ever: see settle_compiler.
    _FLAGS += " --xla_cpu_use_fusion_emitters=false --xla_cpu_enable_concurrency_optimized_scheduler=false"
os.environ.setdefault("XLA_FLAGS", _FLAGS)
sys.path[:0] = [str(ROOT), str(Path(__file__).parent), str(EXAMPLES), str(ROOT / "docs")]


def names(message, *parts):
    """Asserts that each of the parts is in the message, as a word of its own."""
    words = {part: re.sub(r"^(?=\w)|(?<=\w)$", r"\\b", re.escape(part)) for part in map(str, parts)}
    missing = [part for part, word in words.items() if not re.search(word, message)]
    assert not missing, f"{missing} not in {message!r}"


@contextlib.contextmanager
def refuses(*parts, error=ValueError):
    """Fails unless the block raises `error`, with a message that has each of the parts as a word of its own.

    Give the name of the field and the value: `refuses("num_envs", 0)`. How the message is worded is free.
    """
    with pytest.raises(error) as raised:
        yield raised
    names(str(raised.value), *parts)


def save_policy(folder, policy=None):
    """Writes the policy of the run in `folder`, as training does: with the settings in config.json. None: of three numbers."""
    from mjx_dher.policy import Policy
    from mjx_dher.runs.folder import reading, run_folder

    ones = np.ones(1, np.float32)
    policy = policy or Policy(((np.ones((2, 1), np.float32), ones),), ones, ones, ones, ones, 5.0, 200.0)
    content = reading.read_config(folder)
    run_folder.save_policy(folder, policy, reading.identity_of(content, reading.to_spec(folder, content)))


def load_recorded(task):
    """Episodes of the original task; see tests/data/README.md."""
    with np.load(ROOT / "tests" / "data" / f"fetch_{task}.npz") as file:
        return {name: file[name] for name in file.files}


def free_port():
    """Returns a port of this machine at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="session", autouse=True)
def _state(tmp_path_factory):
    """The user's own state folder stays as it is."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="session")
def recorded():
    """Episodes of the original FetchPush."""
    return load_recorded("push")


class Task:
    """An environment and its functions, compiled when they are first called; `_all` for a batch."""

    def __init__(self, name, engine):
        import jax  # after the variables above are set

        from mjx_dher import envs

        self.env = envs.make(name, engine=engine)
        self.reset, self.step = jax.jit(self.env.reset), jax.jit(self.env.step)
        self.reset_all, self.step_all = jax.jit(jax.vmap(self.env.reset)), jax.jit(jax.vmap(self.env.step))


@pytest.fixture(scope="session")
def task():
    """Name and engine -> Task, the same one for all tests.

    MJX takes a quarter of a minute to compile a step, and no cache on the disk holds a program that calls back to Python, as
    every one with native physics does.
    """
    made = {}

    def task(name, engine="native"):
        if (name, engine) not in made:
            made[name, engine] = Task(name, engine)
        return made[name, engine]

    return task


@pytest.fixture(scope="session")
def native(task):
    return task("push").env


@pytest.fixture(scope="session")
def resets(task):
    """Name -> 20,000 first states."""
    import jax

    keys = jax.random.split(jax.random.key(0), 20_000)
    return functools.cache(lambda name: task(name).reset_all(keys))


# The modules that take longest, which start first, so that no worker is left with one of them at the end. Each runs in one
# worker as a whole (--dist loadfile): its fixtures and what it compiles are made once.
LONGEST = (
    *("contract", "identity", "trainer", "mistakes", "render", "cli", "wrong_calls", "actor_critic", "own", "packaging"),
    *("sweep_cli", "pages", "curves", "driver", "docs", "promotion", "simulator", "commands", "splices", "renewals", "engines"),
)


def _share_contexts():
    """Lowers programs in a common MLIR context. JAX makes one for each program, which takes half of the time of a small one.

    A context keeps all constants of its programs, so that another one follows after 1,000 programs. A thread may compile while
    another one lowers in the same context: it has all dialects from the start, and only loading one would disturb others.
    """
    mlir = sys.modules.get("jax._src.interpreters.mlir")
    if not hasattr(mlir, "make_ir_context"):
        return
    make, numbers = mlir.make_ir_context, itertools.count()

    @functools.lru_cache(maxsize=2)
    def kept(thread, thousand):
        return make()

    def shared(*args, **kwargs):
        return make(*args, **kwargs) if args or kwargs else kept(threading.get_ident(), next(numbers) // 1000)

    mlir.make_ir_context = shared


def pytest_configure():
    """Python does not search for reference cycles while modules are imported. That took a third of the time of collection."""
    gc.disable()


def pytest_collection_finish():
    """Python searches less often, and not among what was imported. Otherwise that takes a seventh of the time of the tests.

    Warp compiles for the CPU without optimization, which is quicker. The test modules import it.
    """
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)
    gc.enable()
    _share_contexts()
    _keep_sources()
    if warp := sys.modules.get("warp"):
        warp.config.optimization_level = 0


def _keep_sources():
    """Keeps the source of each class. For each command line, tyro parses the file of its class again, for the docstrings. Where
    pytest is loaded, it also computes a tenth of what it has cached again, at random, to test its cache.
    """
    inspect.getsource = functools.cache(inspect.getsource)
    cache = sys.modules.get("tyro._unsafe_cache")
    if hasattr(cache, "sys"):
        cache.sys = types.SimpleNamespace(modules={})


def pytest_sessionfinish():
    """pytest, its plugins and Python search for reference cycles at the end: among nothing, after this."""
    gc.freeze()


def pytest_collection_modifyitems(items):
    rank = {f"test_{name}": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))  # stable: all else stays in its order
