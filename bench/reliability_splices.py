"""Files of one run in the folder of another with the same code: lines of metrics, policies, results, checkpoints, configs."""

import shutil

from reliability_calls import call, differing, everything, stop_after
from reliability_pairs import SHAPES, of_run, rows, same

from mjx_dher.runs.folder import reading, run_folder

LENGTH, LONGER = 120, 160  # environment steps: 6 epochs, and 8
FILES = ("config.json", "policy.npz", "result.json", "metrics.csv")


def splices(folder):
    """Every file, line of metrics.csv, checkpoint and file of a checkpoint of one run, in the folder of another run."""
    runs = make(folder)
    tried, rejected, faults = 0, 0, []
    for kind in ("stopped", "whole"):
        for theirs in ("seed", "sampler", "length"):
            for name, splice in foreign(runs[theirs][kind]):
                for command in ("resume", "eval", "plot", "report"):
                    copy = folder / "copy"
                    shutil.rmtree(copy, ignore_errors=True)
                    shutil.copytree(runs["mine"][kind], copy)
                    splice(copy)
                    tried += 1
                    status, fault = outcome_of(command, kind, copy, runs)
                    rejected += status == 2
                    if fault:
                        faults.append(f"{command}, {name} of another {theirs} in a run that is {kind}: {fault}")
    return (
        f"{tried} splices of files, lines and checkpoints of another run",
        f"{rejected} rejected by name; {tried - rejected} without effect on what the command reads",
        faults,
    )


def make(folder):
    """Runs of another seed, sampler and length: stopped after four epochs, and whole, with a checkpoint of the end."""
    folder.mkdir()
    runs = {}
    flags = [*SHAPES, "--checkpoint-every", "2", "--keep-end", "--no-curve"]
    others: dict[str, list] = {"seed": ["--seed", "1"], "sampler": ["--sampler", "final"], "length": ["--total-steps", LONGER]}
    for name, more in {"mine": [], **others}.items():
        whole, stopped = folder / f"{name}_whole", folder / f"{name}_stopped"
        assert call(*flags, "--total-steps", LENGTH, *more, "--out", whole)[0] == 0
        stop_after(4, reading.read_spec(whole, trusted=True), stopped)
        runs[name] = {"whole": whole, "stopped": stopped}
    goal = folder / "longer"
    shutil.copytree(runs["mine"]["whole"], goal)
    assert call("resume", goal, "--total-steps", LONGER, "--no-curve")[0] == 0
    runs["right"] = {
        "stopped": of_run(runs["mine"]["whole"]),
        "whole": of_run(goal),
        "rows": {kind: rows(path / "metrics.csv") for kind, path in runs["mine"].items()},
        "eval": {kind: call("eval", path, "--episodes", "4")[1] for kind, path in runs["mine"].items()},
    }
    return runs


def foreign(theirs):
    """Names of splices, and functions that make them in a copy of a run."""
    for name in FILES:
        if (theirs / name).exists():
            yield name, lambda copy, name=name: shutil.copy(theirs / name, copy / name)
    lines = (theirs / "metrics.csv").read_text().splitlines(keepends=True)
    for number in range(1, min(len(lines), 7)):
        yield f"line {number} of metrics.csv", lambda copy, number=number: put_line(copy, number, lines[number])
    for path in run_folder.checkpoints(theirs)[:1]:
        yield "a checkpoint", lambda copy, path=path: put_checkpoint(copy, path)
        for file in sorted(path.rglob("*"))[:6]:
            if file.is_file():
                yield (
                    f"{file.name} of a checkpoint",
                    lambda copy, path=path, file=file: shutil.copy(
                        file, run_folder.checkpoints(copy)[0] / file.relative_to(path)
                    ),
                )
    yield "all checkpoints", lambda copy: put_checkpoints(copy, theirs)


def put_line(copy, number, line):
    path = copy / "metrics.csv"
    lines = path.read_text().splitlines(keepends=True)
    lines[number : number + 1] = [line]
    path.write_text("".join(lines))


def put_checkpoint(copy, path):
    newest = run_folder.checkpoints(copy)[0]
    shutil.rmtree(newest)
    shutil.copytree(path, newest.with_name(path.name))


def put_checkpoints(copy, theirs):
    shutil.rmtree(copy / "checkpoints")
    shutil.copytree(theirs / "checkpoints", copy / "checkpoints")


def outcome_of(command, kind, copy, runs):
    """Status of a command on a copy, and a description of its fault, or an empty text."""
    right, before = runs["right"], everything(copy)
    more: list = {"eval": ["--episodes", "4"], "plot": ["--formats", "svg"], "report": [], "resume": ["--no-curve"]}[command]
    if command == "resume" and kind == "whole":
        more += ["--total-steps", LONGER]
    status, text = call(command, copy, *more)
    if status == 2 and "error: " in text:
        written = [name for name in differing(before, everything(copy)) if not name.endswith(".lock")]
        return status, f"rejected, and changed: {written[:3]}" if written else ""
    if status:
        return status, f"traceback: status {status}: {text[-300:]}"
    if command == "resume":
        wanted = {name: value for name, value in right[kind].items() if name in ("metrics", "policy", "result")}
        is_right = same(lambda path: {x: of_run(path)[x] for x in wanted}, copy, wanted)
        return status, "" if is_right else "silent: another end"
    if command == "eval":
        seen = text.replace(str(copy), ""), right["eval"][kind].replace(str(runs["mine"][kind]), "")
        return status, "" if seen[0] == seen[1] else f"silent: another evaluation: {text[-200:]}"
    return status, "" if rows(copy / "metrics.csv") == right["rows"][kind] else "silent: the curve of another run"
