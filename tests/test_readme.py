import re
import runpy

import numpy as np
from conftest import ROOT

from mjx_dher import stats

README = (ROOT / "README.md").read_text()
# What commands and engines are made of; some of it has a place among the API pages, too.
INNER = (
    "__main__ cli system envs.engines.fused envs.engines.warp envs.engines.graph envs.engines.features"
    " envs.engines.fields envs.engines.pairs envs.engines.batches envs.engines.corrections"
    " runs sweeps testing tools lookup import_paths trust viewer fleet check parallel"
    " policy.learner_policy"
)


def anchors(text):
    """Of a page's headings, as GitHub and the site make them."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_files_and_headings_that_the_documents_name_are_there():
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "bench").glob("*.md")]:
        for link, _, anchor in re.findall(r"\]\((?!https?:)([^)#]*)(#([^)]+))?\)", document.read_text()):
            target = document.parent / link if link else document
            assert target.exists(), f"{document.name} links to {link}"
            assert not anchor or anchor in anchors(target.read_text()), f"{document.name} links to {link}#{anchor}"


def test_the_two_commands_are_what_ci_installs_and_runs():
    assert "python train.py --env push --sampler weighted\n" in README
    ci = (ROOT / ".ci" / "run").read_text()
    assert 'pip install -e ".[test]" && pytest\n' in README
    assert '-e ".[test]"' in ci
    assert "\npytest" in ci


def test_the_picture_of_samplers_has_the_numbers_of_the_tables():
    """Its curves, averaged over epochs, are the mean successes of docs/results.md."""
    figure = runpy.run_path(str(ROOT / "docs" / "make_readme_figure.py"))
    table = (ROOT / "docs" / "results.md").read_text()
    for task, seeds in (("push", 20), ("pick_and_place", 20), ("slide", 10)):
        curves = figure["curves"](task)
        assert len(curves) == (4 if task == "push" else 2)
        assert len(curves["future"].seeds) == seeds
        for sampler, (_, success) in curves.items():
            area = stats.area_under_curve(np.arange(success.shape[1]), success)
            assert f"`{sampler}` |" in table
            assert f"| {area.mean():.3f} (" in table, (task, sampler)


def test_the_site_has_every_module_that_is_for_users():
    pages = "".join(path.read_text() for path in (ROOT / "docs" / "api").glob("*.md"))
    listed = re.findall(r"^- \[`mjx_dher\.([\w.]+)`\]\(../../([\w./]+)\)", pages, re.M)
    assert len(set(listed)) == len(listed)
    modules = {}
    for folder in ("mjx_dher", "envs"):  # mjx_dher/envs is a link
        for path in (ROOT / folder).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts[folder == "mjx_dher" :]
            modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    assert {name: modules[name] for name, _ in listed} == {name: ROOT / path for name, path in listed}
    users = {name for name in modules if name and not any(f"{name}.".startswith(f"{part}.") for part in INNER.split())}
    assert users <= {name for name, _ in listed}


def test_the_index_lists_every_page():
    index = (ROOT / "docs" / "index.md").read_text()
    for page in [page for folder in ("", "api", "experiments") for page in (ROOT / "docs" / folder).glob("*.md")]:
        assert page.name == "index.md" or f"]({page.relative_to(ROOT / 'docs')})" in index, page


def section(text, title):
    return re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", text, re.M | re.S)[1]


def test_numbers_are_those_of_the_pages_that_have_measured_them():
    """Of the README and of docs/field.md: a figure that changes has to change everywhere."""
    read = lambda name: (ROOT / name).read_text()  # noqa: E731
    results, bench, field = read("docs/results.md"), read("bench/README.md") + read("bench/peers.md"), read("docs/field.md")
    presets = read("docs/experiments/presets.md")
    measured = results + read("docs/experiments/paper_set.md") + read("docs/what_helps.md")
    measured += read("docs/experiments/preset_hands.md") + read("docs/experiments/td_controls.md")
    figures = re.findall(r"[+-]?\d\.\d{3}", section(README, "Results in four lines"))
    assert len(figures) > 20
    assert [figure for figure in figures if figure not in measured and f"+{figure}" not in measured] == []
    of_gpu = re.findall(
        r"\| ((?:[01]\.\d{3}, ){4}[01]\.\d{3}) \((?:200 to 204|300 to 304|330 to 334)\) \| [\d,]+ \| [\d.]+ \|$",
        section(presets, "Success by seed"),
        re.M,
    )
    assert len(of_gpu) == 3
    assert [successes for successes in of_gpu if f"| {successes} |" not in bench] == []
    cpu = re.search(r"^\| `push` .*?\| ([\d., ]+) \(600 to 604\)", presets, re.M)[1].split(", ")
    assert cpu == re.findall(r"^\| 60\d \| .*\| ([01]\.\d{3}) \(", section(bench, r"Time to success.*?"), re.M)[:5]
    rates = re.findall(r"\d{1,3}(?:,\d{3})+", section(field, "Speed").split("Transitions")[1])
    assert rates
    assert [rate for rate in rates if rate not in bench] == []
    ours = [row for row in section(field, "Speed").splitlines() if "Push" in row and "H200" in row]
    table = re.search(r"^\| Push \| (.*) \|$", read("docs/engines.md"), re.M)[1].replace(",", "").split(" | ")
    thousands = [str(int(re.search(r"\| ([\d,]+) \|", row)[1].replace(",", "")) // 1000) for row in ours]
    assert thousands == [table[2]]
