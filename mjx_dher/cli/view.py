"""The commands `view` and `demo`."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from mjx_dher import envs
from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import VIEW_PORT, check_engine, check_episodes, find_run, read_run
from mjx_dher.lookup import check_name
from mjx_dher.policy import bundled
from mjx_dher.spec import to_arguments
from mjx_dher.system import subprocesses
from mjx_dher.system.caches import keep_compiled_programs

PARENT = "MJX_DHER_VIEWER_OF"  # variable with the number of the process that a viewer ends with, where one has started it


@dataclasses.dataclass(frozen=True)
class Page:
    """Where the page of the viewer is, and who opens it."""

    host: str = "127.0.0.1"
    """Address to serve the page at. Any other than this machine's own is open to all who reach it."""
    port: int = VIEW_PORT
    """Port; 0: any that is free."""
    open: bool = True
    """Open the page in a browser, where there is one; its address is printed in any case."""


@dataclasses.dataclass(frozen=True)
class ViewArgs:
    """Show policies at play in the browser: drag the goal and the object, and see what they do. Ctrl-C ends it.

    The policy of a run that is still being trained is shown as it learns. Needs the extra: `pip install -e ".[view]"`.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folders, or policies of the package, such as push; the panel chooses among them and those of the package."""
    env: str | None = None
    """Environment to play them in (a name, or module:attribute); their own unless given. Without a run: random
    actions."""
    engine: str | None = None
    """Physics: native, jax, warp or auto; native for the tasks here unless given."""
    seed: int = 1
    """Seed of the first start and goal."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments of the environment, NAME=VALUE each, in place of the runs' own of these names."""
    trust: bool = False
    """Use the code and data that the run folder names, though you have not trained with them on this machine."""
    page: tyro.conf.OmitArgPrefixes[Page] = dataclasses.field(default_factory=Page)


@dataclasses.dataclass(frozen=True)
class DemoArgs:
    """Show the policy of Push at work in the browser. Ctrl-C ends it. Needs the extra: `pip install -e ".[view]"`."""

    page: tyro.conf.OmitArgPrefixes[Page] = dataclasses.field(default_factory=Page)


def demo_command(argv: list[str], console: Console) -> int:
    """Shows a policy of the package."""
    args = parse(DemoArgs, argv)
    first = "push" if "push" in bundled.names() else bundled.names()[0]
    return _view(ViewArgs(runs=(Path(first),), page=args.page), console)


def view_command(argv: list[str], console: Console) -> int:
    """Shows policies at play."""
    return _view(parse(ViewArgs, argv), console)


def _view(args: ViewArgs, console: Console) -> int:
    """Serves the page until a signal ends the process, or the run that it shows has ended."""
    if not args.runs and args.env is None:
        raise ValueError(f"view takes run folders, policies of the package ({', '.join(bundled.names())}), or --env")
    if args.env is not None:
        check_name("env", args.env, envs.list_envs(), custom=True)
    check_engine(args.engine)
    check_episodes(1, args.seed)
    to_arguments(args.env_kwargs)
    folders = [(str(run), find_run(run, console)) for run in args.runs]
    for _, folder in folders:
        read_run(folder, console)
    from mjx_dher.viewer import address

    port = address.check(args.page.host, args.page.port)
    if args.engine in (None, "native"):
        os.environ.setdefault("JAX_PLATFORMS", "cpu")  # one state at a time is slower on a GPU
    from mjx_dher.viewer import server, sources

    given = [sources.of_run(label, folder, args.env, args.env_kwargs) for label, folder in folders]
    given = given or [sources.by_random(str(args.env), args.env_kwargs)]
    others = [source for source in sources.of_package() if source.label not in [label for label, _ in folders]]
    keep_compiled_programs()
    maker = _maker(args.engine)
    with server.Viewer([*given, *others], maker, args.page.host, port, args.seed) as viewer:
        console.print(f"{given[0].label} is at play: {viewer.address} (Ctrl-C ends it)")
        if not address.is_loopback(args.page.host):
            place = "all addresses of this machine" if address.is_everywhere(args.page.host) else args.page.host
            console.print(f"it listens on {place}, without a password: whoever connects can see and use the page")
        if args.page.open and not address.open_browser(viewer.address):
            console.print("there is no browser here that could be opened: open that address in one")
        sys.stdout.flush()
        viewer.run(lambda: PARENT in os.environ and os.environ[PARENT] != str(os.getppid()))
    return 0


class Beside:
    """The viewer of a run that is being trained, in a process of its own, which begins when there is a policy to show.

    Args:
      folder: of the run.
      port: where the page is served, as `address.check` gave it; None for no viewer.
      console: to print to.
    """

    def __init__(self, folder: Path, port: int | None, console: Console):
        self._folder, self._port, self._console = folder, port, console
        self._stack = contextlib.ExitStack()
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def after_epoch(self) -> None:
        """Begins where it has not; tells, once, where it has ended by itself."""
        if self._port is None:
            return
        if self._process is None:
            from mjx_dher.viewer import address

            place = str(subprocesses.PACKAGE.parent)  # of this package, which need not be installed
            code = f"import sys; sys.path.append({place!r}); from mjx_dher.__main__ import main; sys.exit(main())"
            command = (sys.executable, "-c", code, "view", str(self._folder), "--trust", "--port", str(self._port))
            variables = {"JAX_PLATFORMS": "cpu", PARENT: str(os.getpid())}
            self._process = self._stack.enter_context(subprocesses.started(command, variables))
            self._console.print(f"the run is to be seen at {address.address(Page().host, self._port)} in a moment")
        elif self._process.poll() is not None:
            failure = subprocesses.answer(self._process).failure or "it was closed"
            self._console.print(f"the viewer has ended ({failure}); the run goes on")
            self._port = None


def _maker(engine: str | None) -> Callable[[Any], Any]:
    """Returns what makes a source's environment, with physics on one core where that can be: one state is played."""

    def make(source: Any) -> Any:
        arguments = to_arguments(source.env_kwargs)
        if engine is None and source.env in envs.list_envs():
            return envs.make(source.env, engine="native", **{"num_threads": 1, **arguments})
        return envs.make(source.env, engine=engine or "auto", **arguments)

    return make
