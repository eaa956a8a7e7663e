"""Limited machines: disks of six sizes, and four containers. Both need root for mounts in a private namespace."""

import contextlib
import os
import shutil
import subprocess
import sys
import time

from reliability_pairs import ROOT, SHAPES, of_run, same, start

RUN = [*SHAPES, "--total-steps", "2000", "--checkpoint-every", "2", "--no-curve"]  # 100 epochs; a checkpoint takes 0.8 MB
LARGE = "40m"
SIZES = ("100k", "700k", "1m", "2m", "4m", LARGE)


@contextlib.contextmanager
def disk(path, size):
    """A disk in memory."""
    path.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", path], check=True)
    try:
        yield path
    finally:
        subprocess.run(["umount", path], check=True)


def end(process):
    stdout, stderr = process.communicate(timeout=600)
    return process.returncode, stdout, stderr


def faults_of(name, out, status, stdout, stderr):
    """Faults of a program on a full disk."""
    left = [path for path in out.rglob("*") if "partial" in path.name] if out.exists() else []
    if left:
        yield f"{name}: lost: left {left}"
    if "Traceback" in stdout + stderr or (status and not (status == 2 and stderr.startswith("error: "))):
        yield f"{name}: traceback: {status} {stderr[-300:]}"


def fill(process, out):
    """Once the run has two checkpoints, occupies every free block of the disk until the program has ended."""
    filler = out.parent / "filler"
    while process.poll() is None:
        if filler.exists() or len(list((out / "checkpoints").glob("epoch-*"))) == 2:
            with filler.open("ab") as file, contextlib.suppress(OSError):
                os.posix_fallocate(file.fileno(), file.tell(), max(1, shutil.disk_usage(out.parent).free))
        time.sleep(0.005)


def disks(folder):
    """A run on a disk of each size, and on one that fills up. With space, each is then run to the end."""
    whole = folder / "whole"
    assert end(start(*RUN, "--out", whole))[0] == 0
    right = of_run(whole)
    faults, ends = [], []
    for name, size in [*((size, size) for size in SIZES), ("filled", LARGE)]:
        with disk(folder / name, size) as place:
            out = place / "run"
            process = start(*RUN, "--out", out)
            if name == "filled":
                fill(process, out)
            status, stdout, stderr = end(process)
            faults += faults_of(name, out, status, stdout, stderr)
            ends.append("to the end" if status == 0 else "refused" if not out.exists() else "an error")
            (place / "filler").unlink(missing_ok=True)
            subprocess.run(["mount", "-o", f"remount,size={LARGE}", place], check=True)
            if status:
                again = ["resume", out, "--no-curve"] if list(out.glob("checkpoints/epoch-*")) else [*RUN, "--out", out]
                if again[0] != "resume":
                    shutil.rmtree(out, ignore_errors=True)
                faults += faults_of(f"{name}, then {LARGE}", out, *end(start(*again)))
            if not same(of_run, out, right):
                faults.append(f"{name}: silent: the run ended otherwise")
    return (
        f"disks of {', '.join(SIZES)}, and one that fills up",
        f"{', '.join(ends)}; nothing left of failed saves; with space, the same end",
        faults,
    )


GB = 10**9
CACHE = "anon 200000000\ninactive_file 3000000000\nactive_file 800000000\n"
V1 = "total_inactive_file 3000000000\ntotal_active_file 800000000\n"
CONTAINERS: dict[str, tuple[str, dict, tuple]] = {
    # /proc/self/cgroup, files of /sys/fs/cgroup, the most memory that is free, the status of a run of Push, the most cores
    "version 2, cache": (
        "0::/\n",
        {"memory.max": 4 * GB, "memory.current": 39 * GB // 10, "memory.stat": CACHE},
        (3.9e9, 0, 10**6),
    ),
    "nested": (
        "0::/slurm/job\n",
        {
            **{"slurm/job/memory.max": "max", "slurm/job/memory.current": GB, "slurm/job/memory.stat": ""},
            **{"slurm/memory.max": GB, "slurm/memory.current": GB - 50_000_000, "slurm/memory.stat": "anon 950000000\n"},
        },
        (5e7, 2, 10**6),
    ),
    "version 1": (
        "4:memory:/docker/1f\n",
        {"memory/memory.limit_in_bytes": 4 * GB, "memory/memory.usage_in_bytes": 39 * GB // 10, "memory/memory.stat": V1},
        (3.9e9, 0, 10**6),
    ),
    "quota": ("0::/\n", {"cpu.max": "100000 100000"}, (1e15, 0, 1)),
}
INSIDE = 'mount --bind "$1" /sys/fs/cgroup && mount --bind "$2" /proc/$$/cgroup && exec "${@:3}"'
ASK = "from mjx_dher.system import machine; print(machine.free_bytes(), machine.usable_cores())"


def containers(folder):
    """The command in each container: free memory, cores, and whether a run of Push may begin."""
    faults = []
    for number, (name, (groups, files, (most, status, cores))) in enumerate(CONTAINERS.items()):
        tree = folder / str(number)
        for path, text in files.items():
            (tree / path).parent.mkdir(parents=True, exist_ok=True)
            (tree / path).write_text(f"{text}\n")
        (folder / f"{number}.groups").write_text(groups)

        def inside(*command, tree=tree):
            container = ["unshare", "-m", "bash", "-c", INSIDE, "bash", tree, tree.with_suffix(".groups")]
            return subprocess.run([*container, sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False)

        free, usable = map(int, inside("-c", ASK).stdout.split())
        if not 0.95 * min(most, free) <= free <= most or usable > cores:
            faults.append(f"{name}: silent: {free} bytes and {usable} cores")
        run = inside("train.py", "--env", "push", "--preset", "cpu", "--dry-run")
        if run.returncode != status or "Traceback" in run.stderr:
            faults.append(f"{name}: traceback: {run.returncode} {run.stderr[-300:]}")
    return (
        f"{len(CONTAINERS)} containers: {', '.join(CONTAINERS)}",
        "memory and cores are those of the container; a run that does not fit is refused",
        faults,
    )
