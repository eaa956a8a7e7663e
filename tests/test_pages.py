"""What the pages say in tables: every table renders, and numbers are those of the committed curves."""

import csv
import functools
import re

import make_comparison_tables
import make_preference_figure
import make_results_figures
import make_samplers_figure
import make_scaling_figure
import numpy as np
import paper_analysis
import paper_set
import pytest
import scipy.stats
from conftest import ROOT, refuses
from markdown_it import MarkdownIt

PAGES = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not any(part.startswith(".") and part != ".github" for part in path.relative_to(ROOT).parts[:-1])
)
MARKDOWN = MarkdownIt("commonmark").enable("table")


def broken_tables(text):
    """What is wrong with the tables of a page: lines that look like a row and are in none, and rows of another length."""
    lines, in_table, apart, problems = text.splitlines(), {}, set(), []
    for token in MARKDOWN.parse(text):
        if token.type == "table_open":
            in_table |= dict.fromkeys(range(*token.map), token.map[0])
        elif token.type in ("fence", "code_block", "html_block"):
            apart |= set(range(*token.map))
    for number, line in enumerate(lines):
        if number in in_table:
            if len(cells(line)) != len(cells(lines[in_table[number]])):
                problems.append(f"line {number + 1} has {len(cells(line))} cells")
        elif line.lstrip().startswith("|") and number not in apart:
            problems.append(f"line {number + 1} is no row of a table")
    return problems


def cells(line):
    return re.split(r"(?<!\\)\|", line.strip().removeprefix("|").removesuffix("|"))


def test_every_table_renders():
    assert {page: problems for page in PAGES if (problems := broken_tables(page.read_text()))} == {}


def test_a_broken_table_would_be_noticed():
    for text, problems in [
        ("| a | b |\n|---|---|\n| 1 | 2 |\n", []),
        ("| a | b |\n|---|---|\n| 1 | 2 |\n\n| 3 | 4 |\n", ["line 5 is no row of a table"]),
        ("| a | b |\n|---|---|\n| 1 |\n| 1 | 2 | 3 |\n", ["line 3 has 1 cells", "line 4 has 3 cells"]),
        ("| a | b |\n| 1 | 2 |\n", ["line 1 is no row of a table", "line 2 is no row of a table"]),
        ("text\n| a | b |\n|---|\n", ["line 2 is no row of a table", "line 3 is no row of a table"]),
        ("```\n| a |\n```\n\n| a \\| b |\n|---|\n| c |\n", []),
    ]:
        assert broken_tables(text) == problems


def test_the_tables_of_results_are_those_of_the_curves():
    tables = make_results_figures.blocks(paper_set.load_set(paper_set.FOLDER), paper_analysis.load())
    pages = make_results_figures.PAGES
    assert sorted(name for names in pages.values() for name in names) == sorted(tables)
    for path, names in pages.items():
        page = path.read_text()
        assert paper_analysis.with_tables(page, make_results_figures.SCRIPT, {name: tables[name] for name in names}) == page


def test_each_table_of_results_with_numbers_is_made_from_the_curves():
    """Except tables of departures, claims and commands: nobody would check a number in another table."""
    text = (ROOT / "docs" / "results.md").read_text()
    rest = re.sub(r"<!-- (\w+): docs/make_results_figures.py -->.*?<!-- end of \1 -->", "", text, flags=re.DOTALL)
    tables = [token.map for token in MARKDOWN.parse(rest) if token.type == "table_open"]
    heads = [rest.splitlines()[start] for start, _ in tables]
    assert heads == [
        "| departure from the paper | where |",
        "| term | meaning |",
        "| the paper says | finding |",
        "| figure of the paper | ours | command | curves | minutes, GPU |",
        "| script | makes |",
    ]


def test_the_table_of_readings_is_what_the_weights_are():
    page = make_samplers_figure.PAGE.read_text()
    assert make_samplers_figure.with_table(page) == page


def test_the_tables_of_scaling_are_of_the_file():
    page = make_scaling_figure.PAGE.read_text()
    assert make_scaling_figure.with_table(page) == page


REPORTS = {page.name: page for page in make_comparison_tables.PAGES}


@functools.cache
def report(name):
    """The rows of a report."""
    return tuple(make_comparison_tables.read(REPORTS[name]))


@pytest.mark.parametrize("name", REPORTS)
def test_tables_of_comparisons_are_those_of_their_reports(name):
    """An arm is shown when all of its seeds have been run."""
    page, rows = REPORTS[name], report(name)
    assert make_comparison_tables.with_table(page, rows) == page.page.read_text()
    assert {row.seeds for row in rows} == {page.seeds}


def test_the_verdicts_that_joint_flips_would_change_are_named():
    page = " ".join((ROOT / "docs" / "what_helps.md").read_text().split())
    rows = [row for name in REPORTS for row in report(name)]
    changed = [row for row in rows if row.p_value == row.p_value and (row.p_corrected < 0.05) != (row.p_joint < 0.05)]
    shown = [("energy", "slide"), ("energy_clipped", "slide"), ("k1", "hand_reach"), ("k8", "hand_reach")]
    shown += [("not_misleading", "pick_and_place")] * 2 + [("tqc_k4", "push")]
    assert sorted((row.arm, row.task) for row in changed) == shown
    assert all(f"({row.p_joint:.3f})" in page for row in changed)


def test_a_page_without_one_place_for_a_table_is_refused():
    for page in ("", "<!-- a: docs/x.py -->\n", 2 * "<!-- a: docs/x.py -->\n<!-- end of a -->\n"):
        with refuses("a"):
            paper_analysis.with_tables(page, "docs/x.py", {"a": "| table |"})


def test_readings_by_formula():
    """Total variation from `future` as NumPy computes it from the formulas on the page."""
    formulas = {
        "`mean`, `linear`": lambda d: np.maximum(2 - d / d.mean(), 0),
        "`sum`, `linear`": lambda d: 1 - d / d.sum(),
        "`max`, `linear`": lambda d: 1 - d / d.max(),
        "`minmax`, `linear`": lambda d: 1 - (d - d.min()) / (d.max() - d.min()),
        "`none`, `softmax`": lambda d: np.exp(-d / 0.05),
        "`far`, `linear`": lambda d: d,
        "`epsilon_closest`": lambda d: 0.2 / d.size + 0.8 * (d == d.min()) / (d == d.min()).sum(),
    }
    rows = dict(make_samplers_figure.rows())
    for name, formula in formulas.items():
        weights = [formula(np.asarray(d, np.float32)) for d in make_samplers_figure.SITUATIONS.values()]
        expected = [np.abs(w / w.sum() - 1 / w.size).sum() / 2 for w in weights]
        np.testing.assert_allclose(rows[name], expected, atol=1e-5, err_msg=name)


def test_loss_grows_with_the_preference_for_near_goals():
    """Thirteen settings, their correlation as the page has it, and one difference by hand."""
    found = make_preference_figure.points()
    assert len(found) == 13
    page = (ROOT / "docs" / "results.md").read_text()
    own = make_preference_figure.points(own=True)
    assert len(own) == 10
    for points in (found, own):
        assert f"Spearman {make_preference_figure.correlation(points):.2f}" in page
    ranks = [np.argsort(np.argsort(values)) for values in ([p.share for p in found], [p.gain.mean for p in found])]
    assert np.corrcoef(*ranks)[0, 1] < -0.85  # ties, of `max` and `minmax`, apart
    push = paper_analysis.read(paper_set.FOLDER / "push_curves.csv")
    base, own = (push["samplers", name].success[:, :30] for name in ("future", "closest"))
    by_hand = np.mean([np.trapezoid(a - b) / 29 for a, b in zip(own, base)])
    assert {p.name: p.gain.mean for p in found}["closest"] == pytest.approx(by_hand)


SUCCESS = re.compile(r"[01]\.\d{3}")


def published(task, preset):
    """The success rates of a preset's seeds, and its environment steps, in docs/preset_success.csv."""
    with (ROOT / "docs" / "preset_success.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if (row["task"], row["preset"]) == (task, preset)]
    return [row["success"] for row in rows], {row["env_steps"] for row in rows}


def test_the_table_of_presets_is_that_of_the_file():
    lines = (ROOT / "docs" / "experiments" / "presets.md").read_text().splitlines()
    (head,) = (i for i, line in enumerate(lines) if line.startswith("|") and "preset `cpu`" in line and "preset `gpu`" in line)
    names = cells(lines[head])
    tasks = set()
    for line in lines[head + 2 :]:
        if not line.startswith("|"):
            break
        row = cells(line)
        task = row[0].strip().strip("`")
        tasks.add(task)
        for preset in ("cpu", "gpu"):
            (column,) = (i for i, name in enumerate(names) if f"preset `{preset}`" in name)
            rates, steps = published(task, preset)
            assert SUCCESS.findall(row[column]) == rates, (task, preset)
            assert {row[column + 1].strip().replace(",", "")} == (steps or {""}), (task, preset)
    assert tasks == {"push", "pick_and_place", "slide", "reach"}


FIRST_UNSEEN = {  # where not 600: the preset had changed since
    ("gpu", "push"): 750,
    **dict.fromkeys((("cpu", "pick_and_place"), ("cpu", "slide"), ("frugal", "push"), ("frugal", "pick_and_place")), 620),
    **{("gpu", name): 620 for name in ("pick_and_place", "egg_rotate")},
    **{("gpu", f"block_rotate_{name}"): 620 for name in ("z", "parallel", "xyz")},
}


def test_the_table_of_unseen_seeds_is_of_the_file():
    finals = {}
    with (ROOT / "docs" / "unseen_runs.csv").open() as file:
        for row in csv.DictReader(file):
            first = FIRST_UNSEEN.get((row["learner"], row["task"]), 600)
            assert first <= int(row["seed"]) < first + 10
            finals.setdefault((row["learner"], row["task"]), []).append(float(row["final"]))
    page = (ROOT / "docs" / "experiments" / "presets.md").read_text()
    shown = {
        (preset, task): SUCCESS.findall(line)
        for preset, task, line in re.findall(r"\| `(cpu|gpu|frugal)`, `(\w+)`[^|]* (\|.*)", page)
    }
    assert shown.keys() == finals.keys()
    for of, values in finals.items():
        assert len(values) == 10
        error = max(scipy.stats.sem(values), 1e-9)  # all can be 1
        low, high = scipy.stats.t.interval(0.95, len(values) - 1, np.mean(values), error)
        numbers = (min(values), np.median(values), max(values), np.mean(values), low, min(high, 1.0))
        assert shown[of] == [f"{number:.3f}" for number in numbers], of


def test_the_readme_s_ranges_are_of_these_seeds_and_of_the_originals():
    readme, bench = (ROOT / "README.md").read_text(), (ROOT / "bench" / "README.md").read_text()
    for task in ("push", "pick_and_place", "slide"):
        row = next(cells(line) for line in readme.splitlines() if line.startswith(f"| `{task}` | 0"))
        there = next(cells(line)[5] for line in bench.splitlines() if re.match(rf"\| {task} \| [\d,]+ \| \d+ \|", line))
        for shown, seeds in ((row[1], SUCCESS.findall(there)), (row[3], published(task, "cpu")[0])):
            assert shown.strip() == f"{min(seeds)} to {max(seeds)}"


README_EFFECTS = [  # task, sweep and setting, baseline's, sign of the difference in the text
    ("push", ("own_push", "weighted"), ("own_push", "future"), 1),
    ("pick_and_place", ("own_pick_and_place", "weighted"), ("own_pick_and_place", "future"), 1),
    ("push", ("own_methods", "epsilon_closest"), ("own_push", "future"), -1),
    ("push", ("own_methods", "closest"), ("own_methods", "epsilon_closest"), -1),
    ("push", ("k_push", "future, her_k 16"), ("samplers", "future"), 1),
    ("slide", ("k_slide", "future, her_k 16"), ("slide", "future"), -1),
    ("push", ("eventful_push", "future, priority_fraction 0.5"), ("samplers", "future"), 1),
    ("pick_and_place", ("eventful_pick_and_place", "future, priority_fraction 0.5"), ("pick_and_place", "future"), 1),
]


@pytest.fixture(scope="module")
def committed():
    """Success by task, sweep, setting and seed, as in the files."""
    curves = {}
    for task in paper_analysis.NAMES:
        with (ROOT / "docs" / "paper" / f"{task}_curves.csv").open() as file:
            for row in csv.DictReader(file):
                by_seed = curves.setdefault((task, row["sweep"], row["setting"]), {})
                by_seed.setdefault(int(row["seed"]), []).append(float(row["success_rate"]))
    return curves


@pytest.mark.parametrize(("task", "own", "base", "sign"), README_EFFECTS)
def test_the_effects_in_the_readme_by_scipy(committed, task, own, base, sign):
    """Areas by the trapezoidal rule over the common epochs, paired by seed, with scipy's t interval."""
    a, b = committed[task, *own], committed[task, *base]
    epochs = min(len(curve) for curve in (*a.values(), *b.values()))
    area = lambda curve: np.trapezoid(curve[:epochs]) / (epochs - 1)  # noqa: E731
    test = scipy.stats.ttest_rel(*([sign * area(curves[seed]) for seed in a] for curves in (a, b)))
    low, high = test.confidence_interval(0.95)
    mean = np.mean([sign * (area(a[seed]) - area(b[seed])) for seed in a])
    readme = " ".join((ROOT / "README.md").read_text().split())
    signed, plain = (f"{mean:{f}.3f} ({low:{f}.3f} to {high:{f}.3f})" for f in ("+", ""))
    assert signed in readme or plain in readme, (signed, plain)


@pytest.mark.parametrize(("first_seed", "pairs"), [(100, 40), (0, 50)])
def test_the_gain_of_td_error_with_fresh_seeds_and_over_all_sweeps(first_seed, pairs):
    """Mean and Student's t interval. Seeds from 100 on had no part in the choice of the arm, and the README has their gain."""
    runs = {}
    for name in ("bakeoff_runs", "bakeoff_repeat_runs", "bakeoff_third_runs", "td_controls_runs"):
        with (ROOT / "docs" / f"{name}.csv").open() as file:
            for row in csv.DictReader(file):
                if row["learner"] == "best":
                    runs[row["task"], row["arm"], int(row["seed"])] = float(row["mean_success"])
    page, readme = (" ".join((ROOT / name).read_text().split()) for name in ("docs/what_helps.md", "README.md"))
    for task in ("pick_and_place", "slide"):
        seeds = [seed for name, arm, seed in runs if (name, arm) == (task, "td_error") and seed >= first_seed]
        assert len(seeds) == pairs
        gains = np.array([runs[task, "td_error", seed] - runs[task, "future", seed] for seed in seeds])
        low, high = scipy.stats.t.interval(0.95, pairs - 1, gains.mean(), scipy.stats.sem(gains))
        shown = f"{gains.mean():.3f} ({low:.3f} to {high:.3f})"
        assert shown in page
        assert first_seed == 0 or shown in readme


def areas(curves, epochs):
    """Mean success by seed, by the trapezoidal rule."""
    return {seed: np.trapezoid(curve[:epochs]) / (min(epochs, len(curve)) - 1) for seed, curve in curves.items()}


def test_slide_s_pooled_loss_over_all_epochs_and_over_the_first_hundred(committed):
    """The sweeps differ by no more than their seeds make them, so 1 / variance is their weight."""
    sweeps = [({name: committed["slide", sweep, name] for name in ("weighted", "future")}) for sweep in ("own_slide", "slide")]
    older = paper_analysis.read(ROOT / "docs" / "paper_slide_curves.csv")
    for sweep in ("samplers", "fast", "hopper"):
        sweeps.append({name: dict(enumerate(older[sweep, name].success)) for name in ("weighted", "future")})
    results, readme = (" ".join((ROOT / name).read_text().split()) for name in ("docs/results.md", "README.md"))
    for epochs in (200, 100):
        gains = [
            np.array([areas(own["weighted"], epochs)[s] - x for s, x in areas(own["future"], epochs).items()]) for own in sweeps
        ]
        means, weights = np.array([x.mean() for x in gains]), np.array([len(x) / x.var(ddof=1) for x in gains])
        mean, half = np.average(means, weights=weights), scipy.stats.t.ppf(0.975, 4) / weights.sum() ** 0.5
        assert weights @ (means - mean) ** 2 < 4
        if epochs == 200:
            assert f"{-mean:.3f} ({-mean - half:.3f} to {-mean + half:.3f})" in readme
            assert f"| Slide | 5 | 50 | {mean:+.3f} | {mean - half:+.3f} to {mean + half:+.3f} |" in results
        else:
            assert f"{mean:.3f} ({mean - half:.3f} to {mean + half:+.3f})" in results


def test_what_the_pages_say_of_slide_s_late_epochs(committed):
    results, plan = (
        " ".join((ROOT / "docs" / n).read_text().split()) for n in ("results.md", "experiments/paper_own_cycles.md")
    )
    worst, shares = [], []
    for sweep in ("own_slide", "slide"):
        late = {
            name: np.array([np.mean(x[-20:]) for x in committed["slide", sweep, name].values()])
            for name in ("weighted", "future")
        }
        assert late["future"].min() > 0.55
        gains = late["weighted"] - late["future"]
        assert gains.argmin() == late["weighted"].argmin()
        worst.append(late["weighted"].min())
        shares.append(gains.min() / gains.sum())
    assert f"averages {worst[0]:.3f}, and {worst[1]:.3f} with one cycle per epoch" in results
    assert f"These two runs make up {100 * shares[0]:.0f} % and {100 * shares[1]:.0f} % of the late difference" in results
    own, long = (np.mean(list(committed["slide", sweep, "future"].values()), axis=0) for sweep in ("own_slide", "slide"))
    tens = [x[i : i + 10].mean() for x, i in ((long, 30), (long, 90), (long, 190), (own, 30), (own, 90))]
    assert "from {:.3f} in epochs 31 to 40 to {:.3f} in 91 to 100, and to {:.3f} in the last ten".format(*tens[:3]) in plan
    assert "With the paper's cycles it rises from {:.3f} to {:.3f}".format(*tens[3:]) in plan


def test_the_benchmarks_say_the_same_of_the_presets():
    text = (ROOT / "bench" / "README.md").read_text()
    for task in ("push", "pick_and_place", "slide"):
        (row,) = (cells(line) for line in text.splitlines() if re.match(rf"\| {task} \| [\d,]+ \| \d+ \|", line))
        rates, steps = published(task, "gpu")
        assert SUCCESS.findall(row[4]) == rates
        assert {row[1].strip().replace(",", "")} == steps
    finals = re.findall(r"^\| 60\d \| .*?\| ([01]\.\d{3}) \([01]\.\d{3}-[01]\.\d{3}\) +\| 0\.0\d\d", text, re.MULTILINE)
    assert finals == published("push", "cpu")[0]
