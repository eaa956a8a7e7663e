"""The documents' snippets and commands: what is shown can be run."""

import contextlib
import io
import itertools
import re
import shlex
import tomllib

import pytest
import tyro
from conftest import ROOT

from mjx_dher import cli
from mjx_dher.cli.sweep import parse_sweep_args
from mjx_dher.cli.train import parse_train_args

DOCUMENTS = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in [
        *ROOT.glob("*.md"),
        *ROOT.glob(".github/**/*.md"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("mjx_dher/**/*.md"),
        *ROOT.glob("bench/*.md"),
    ]
    if path.name not in ("CHANGELOG.md", "history.md")  # they tell of what there was
}
EXTRAS = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])


def blocks(language):
    """Every fenced block of a language: document, code, and the paragraph after it."""
    for name, text in DOCUMENTS.items():
        for found in re.finditer(rf"```{language}\n(.*?)```\n+([^\n]*)", text, re.S):
            yield name, found[1], found[2]


# Blocks that other tests run: the document, and the test.
ELSEWHERE = {
    "docs/gymnasium.md": "test_gym_use.py",
    "docs/policies.md": "test_export.py",
    "docs/start.md": "test_start.py",
    "docs/tutorial.md": "test_examples.py",
    "docs/real_robot.md": "test_your_robot.py",
    "docs/your_robot.md": "test_your_robot.py",
}
SNIPPETS = list(blocks("python"))


@pytest.mark.parametrize("document", sorted({name for name, _, _ in SNIPPETS}))
def test_snippets_run_here_or_where_they_are_said_to(document):
    shown = [(code, after) for name, code, after in SNIPPETS if name == document]
    if document in ELSEWHERE:
        assert document.rpartition("/")[2] in (ROOT / "tests" / ELSEWHERE[document]).read_text()
        for code, _ in shown:
            compile(code, document, "exec")
        return
    for code, after in shown:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, document, "exec"), {"__name__": "snippet"})
        if expected := re.match(r"It prints `(.*?)`", after):
            assert " ".join(printed.getvalue().split()) == expected[1]


def shell_lines(script):
    """The commands of a shell script as lists of words: continued lines joined, comments dropped, its own variables put in."""
    variables = {}
    for line in script.replace("\\\n", " ").splitlines():
        line = re.sub(r"\$(\w+)", lambda name: variables.get(name[1], name[0]), line)
        words = shlex.split(line, comments=True)
        if len(words) == 1 and (assigned := re.fullmatch(r"(\w+)=(.*)", words[0])):
            variables[assigned[1]] = assigned[2]
        command = []
        for word in [*itertools.takewhile(lambda word: word != ">", words), "&&"]:
            if word in ("&&", "&", ";", "|"):
                if command:
                    yield command
                command = []
            elif command or not re.match(r"[A-Z_]+=", word):  # a variable for this command alone
                command.append(word)


def in_prose():
    """Commands in the text, between backticks."""
    for name, text in DOCUMENTS.items():
        prose = re.sub(r"```.*?```", "", text, flags=re.S)
        for span in re.findall(r"`((?:python|mjx-dher|pip|bash|\.ci)[^`]*)`", prose):
            yield name, " ".join(span.split())


SCRIPTS = {name: "".join(code for document, code, _ in blocks("bash") if document == name) for name in DOCUMENTS}
COMMANDS = [(name, words) for name, script in SCRIPTS.items() for words in shell_lines(script)]
SESSIONS = [(name, line) for name, text in DOCUMENTS.items() for line in re.findall(r"^\$ (.*)$", text, re.M)]
COMMANDS += [(name, words) for name, line in SESSIONS for words in shell_lines(line)]
COMMANDS += [(name, words) for name, span in in_prose() for words in shell_lines(span)]


def ours(words):
    """The arguments of this library's command line, or None."""
    if words[:2] == ["python", "train.py"]:
        return words[2:]
    is_one = words[0] == "mjx-dher" and (words[1:2] == [] or words[1] in cli.COMMANDS or words[1].startswith("-"))
    return words[1:] if is_one else None


OURS = {shlex.join(arguments): name for name, words in COMMANDS if (arguments := ours(words)) is not None}


class Parsed(BaseException):
    """The arguments were taken: nothing more is to happen."""


def test_each_command_line_is_one(monkeypatch, capsys):
    parse = tyro.cli

    def parse_only(*args, **kwargs):
        parse(*args, **kwargs)
        raise Parsed

    for line in OURS:
        if "COMMAND" in line or line == "--version":
            continue
        arguments = shlex.split(line)
        name = arguments[0] if arguments and arguments[0] in cli.COMMANDS else "train"
        if "--help" in arguments:
            arguments.remove("--help")
        for option in {"--config", "--demonstrations"} & set(arguments):  # there is no such run or file here
            at = arguments.index(option)
            del arguments[at : at + 2]
        if "module:attribute" not in line and name in ("train", "sweep"):  # values and all
            parse_train_args(arguments) if name == "train" else parse_sweep_args([*arguments[1:], *_out(arguments)])
        else:
            monkeypatch.setattr(tyro, "cli", parse_only)
            with pytest.raises(Parsed):
                cli.main([word for word in arguments if word != "..."])
            monkeypatch.setattr(tyro, "cli", parse)


def _out(arguments):
    return [] if "--out" in arguments else ["--out", "DIR"]


def test_other_commands_name_what_is_there():
    """Files, their options, extras: of scripts that a test of their own runs, or that say which machine they need."""
    for words in [words for _, words in COMMANDS if ours(words) is None]:
        line = " ".join(words)
        assert set(",".join(re.findall(r"\.\[([\w,]+)\]", line)).split(",")) - {""} <= EXTRAS, line
        if words[0] != "python" or not words[1].endswith(".py"):
            continue
        if "NAME.py" not in line:
            script = (ROOT / words[1]).read_text()
            flags = {word for word in words[2:] if word.startswith("--")}
            missing = [flag for flag in flags if flag not in script and flag[2:].replace("-", "_") not in script]
            assert not missing, f"{line}: {missing}"
