"""Containers: memory and cores, from files of control groups below a folder that stands for the root, and no home folder."""

import os
import pwd
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from mjx_dher import spec
from mjx_dher.system import machine
from mjx_dher.tools import doctor, transfer

GB = 10**9
CACHE = "anon 200000000\nfile 3900000000\ninactive_file 3000000000\nactive_file 700000000\nslab_reclaimable 100000000\n"
OLD_CACHE = "cache 3900000000\ninactive_file 1\ntotal_inactive_file 3000000000\ntotal_active_file 800000000\n"


def v2(group, limit, used, stat=CACHE):
    return {f"{group}/memory.max": limit, f"{group}/memory.current": used, f"{group}/memory.stat": stat}


def v1(group, limit, used, stat=OLD_CACHE):
    return {
        f"memory{group}/memory.limit_in_bytes": limit,
        f"memory{group}/memory.usage_in_bytes": used,
        f"memory{group}/memory.stat": stat,
    }


def quota(group, text):
    return {f"{group}/cpu.max": text}


CONTAINERS = {
    # name: (/proc/self/cgroup, files below /sys/fs/cgroup, free memory, cores of 64)
    "none": ("0::/\n", {}, 16 * GB, 64),
    "no limit": ("0::/\n", {**v2("", "max", 4 * GB), **quota("", "max 100000")}, 16 * GB, 64),
    "page cache": ("0::/\n", v2("", 4 * GB, 3900000000), 3900000000, 64),
    "full": ("0::/\n", v2("", 4 * GB, 3900000000, "anon 3900000000\nfile 0\n"), 100000000, 64),
    "over its limit": ("0::/\n", {**v2("", "max", 3 * GB, ""), "memory.high": 2 * GB}, 0, 64),
    "nested": (
        "0::/slurm/job_7/step_0\n",
        {**v2("slurm/job_7/step_0", "max", GB), **v2("slurm/job_7", 2 * GB, GB, ""), **v2("slurm", 9 * GB, 8 * GB, "file 0\n")},
        GB,
        64,
    ),
    "gone and a hybrid": ("4:memory:/gone\n0::/user\n", {**v2("unified/user", 3 * GB, GB, "")}, 2 * GB, 64),
    "v1": (
        "4:memory:/slurm/job\n1:cpu,cpuacct:/\n",
        {**v1("/slurm/job", 4 * GB, 3900000000), **v1("", 2**63 - 4096, GB)},
        3900000000,
        64,
    ),
    "v1 as docker shows it": ("4:memory:/docker/1f\n0::/\n", v1("", 4 * GB, GB, ""), 3 * GB, 64),
    "quota": (
        "0::/a/b\n",
        {**quota("a/b", "max 100000"), **quota("a", "150000 100000"), **quota("", "800000 100000")},
        16 * GB,
        2,
    ),
    "small quota": ("0::/\n", quota("", "5000 100000"), 16 * GB, 1),
    "v1 quota": ("1:cpuacct,cpu:/\n", {"cpu/cpu.cfs_quota_us": 300000, "cpu/cpu.cfs_period_us": 100000}, 16 * GB, 3),
    "v1 no quota": ("1:cpu:/\n", {"cpu/cpu.cfs_quota_us": -1, "cpu/cpu.cfs_period_us": 100000}, 16 * GB, 64),
    "garbage": ("0\n:\n0::/../..\n", {**v2("", "many", "few"), **quota("", "0 0 0")}, 16 * GB, 64),
}


@pytest.mark.parametrize("name", CONTAINERS)
def test_memory_and_cores_are_those_of_the_container(name, tmp_path, monkeypatch):
    groups, files, free, cores = CONTAINERS[name]
    files = {"proc/self/cgroup": groups, "proc/meminfo": "MemFree: 1 kB\nMemAvailable: 15625000 kB\n"} | {
        f"sys/fs/cgroup/{path}": text for path, text in files.items()
    }
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(f"{text}\n")
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)))
    assert (machine.free_bytes(tmp_path), machine.usable_cores(tmp_path)) == (free, cores)


def test_nothing_is_known_without_these_files(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert (machine.free_bytes(tmp_path), machine.usable_cores(tmp_path)) == (None, 1)


@pytest.mark.parametrize(("quotas", "threads"), [([0.5], "1"), ([], None)])
def test_xla_keeps_to_a_quota(quotas, threads, monkeypatch):
    """It starts a pool of as many threads as it takes the machine to have cores, unless NPROC says otherwise."""
    monkeypatch.setattr(machine, "_quotas", lambda root: iter(quotas))
    monkeypatch.setenv("NPROC", "")
    monkeypatch.delenv("NPROC")
    machine.check_platform()
    assert os.environ.get("NPROC") == threads


def test_training_without_compilation_is_refused():
    with jax.disable_jit(), pytest.raises(ValueError, match="JAX_DISABLE_JIT"):
        machine.prepare()


@pytest.fixture
def no_home(monkeypatch):
    """A user without HOME and without a line in /etc/passwd."""
    for name in ("HOME", "XDG_CACHE_HOME", "MINARI_DATASETS_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", lambda uid: {}[uid])
    with pytest.raises(RuntimeError):
        Path.home()


def test_without_a_home_folder_programs_are_not_kept(no_home, monkeypatch, capsys):
    config = SimpleNamespace(jax_compilation_cache_dir=None, update=None)
    monkeypatch.setattr(jax, "config", config)
    machine.keep_compiled_programs()
    assert config.jax_compilation_cache_dir is None
    assert capsys.readouterr().err.count("\n") == 1


def test_without_a_home_folder_only_what_needs_it_is_refused(no_home):
    with pytest.raises(OSError, match="HOME"):
        transfer.default_environment()
    with pytest.raises(ValueError, match="demonstrations"):
        spec.find_demonstrations("nowhere")
    assert doctor._brief("/usr/bin/ffmpeg") == "/usr/bin/ffmpeg"
    assert "HOME" in doctor._guarded(doctor._cache)
