"""The commands `view` and `demo`."""

import contextlib
import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from mjx_dher import envs, lookup
from mjx_dher.cli import parse
from mjx_dher.cli.common import VIEW_PORT, EnvKwargs, Trust
from mjx_dher.cli.policies import check_play, find_run, read_run
from mjx_dher.policy import bundled
from mjx_dher.spec import to_arguments
from mjx_dher.system import subprocesses
from mjx_dher.system.machine import keep_compiled_programs

PARENT = "MJX_DHER_VIEWER_OF"  # variable with the id of the process that started a viewer and with which it ends


@dataclasses.dataclass(frozen=True)
class Page:
    """Address of the viewer's page, and whether to open it."""

    host: str = "127.0.0.1"
    """Address to serve the page at. Any address other than a local one is open to everyone who can reach it."""
    port: int = VIEW_PORT
    """Port; 0 means any free port."""
    open: bool = True
    """Open the page in a browser if there is one. Its address is always printed."""


@dataclasses.dataclass(frozen=True)
class ViewArgs:
    """Show policies in the browser: drag the goal and the object, and watch. Ctrl-C ends it.

    A run that is still training is shown as it learns. Needs the extra `view`.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folders, or bundled policies such as push. The panel offers these and all bundled policies."""
    env: str | None = None
    """Environment to play in (a name, or module:attribute). Default: the runs'. Without a run, actions are random."""
    engine: str | None = None
    """Physics: native, jax, warp or auto. Default: native for the built-in tasks."""
    seed: int = 1
    """Seed of the first start and goal."""
    env_kwargs: EnvKwargs = ()
    trust: Trust = False
    page: tyro.conf.OmitArgPrefixes[Page] = dataclasses.field(default_factory=Page)


@dataclasses.dataclass(frozen=True)
class DemoArgs:
    """Show the bundled policy of Push in the browser. Ctrl-C ends it. Needs the extra `view`."""

    page: tyro.conf.OmitArgPrefixes[Page] = dataclasses.field(default_factory=Page)


def demo_command(argv: list[str], console: Console) -> int:
    """Shows a bundled policy."""
    args = parse(DemoArgs, argv)
    first = "push" if "push" in bundled.names() else bundled.names()[0]
    return _view(ViewArgs(runs=(bundled.FOLDER / first,), page=args.page), console)


def view_command(argv: list[str], console: Console) -> int:
    """Shows policies in the browser."""
    return _view(parse(ViewArgs, argv), console)


def _view(args: ViewArgs, console: Console) -> int:
    """Serves the page until a signal ends the process, or the run that it shows has ended."""
    if not args.runs and args.env is None:
        raise ValueError(f"view needs run folders, bundled policies ({', '.join(bundled.names())}), or --env")
    if args.env is not None:
        lookup.check_name("env", args.env, envs.list_envs(), custom=True)
    check_play(args.seed, args.engine, env_kwargs=args.env_kwargs)
    places = [(run, find_run(run, console)) for run in args.runs]
    folders = [(folder.name if bundled.is_shipped(folder) else lookup.escaped(str(run)), folder) for run, folder in places]
    for _, folder in folders:
        read_run(folder, console)
    from mjx_dher.viewer import address

    port = address.check(args.page.host, args.page.port)
    if args.engine in (None, "native"):
        os.environ.setdefault("JAX_PLATFORMS", "cpu")  # a single state is slower on a GPU
    from mjx_dher.viewer import server, sources

    given = [sources.of_run(label, folder, args.env, args.env_kwargs) for label, folder in folders]
    given = given or [sources.by_random(str(args.env), args.env_kwargs)]
    others = [source for source in sources.of_package() if source.label not in [label for label, _ in folders]]
    keep_compiled_programs()
    maker = _maker(args.engine)
    with server.Viewer([*given, *others], maker, args.page.host, port, args.seed) as viewer:
        console.print(f"showing {given[0].label}: {viewer.address} (Ctrl-C ends it)")
        if not address.is_loopback(args.page.host):
            place = "all addresses of this machine" if address.is_everywhere(args.page.host) else args.page.host
            console.print(f"it listens on {place} without a password: anyone who connects can see and use the page")
        if args.page.open and not address.open_browser(viewer.address):
            console.print("no browser was found: open that address in one")
        sys.stdout.flush()
        viewer.run(lambda: PARENT in os.environ and os.environ[PARENT] != str(os.getppid()))
    return 0


@contextlib.contextmanager
def beside(folder: Path, port: int, console: Console) -> Iterator[Callable[[], None]]:
    """Viewer of a run in training, in its own process. Yields a function to call after each epoch.

    The first call starts the viewer, because there is a policy to show. A later one reports if it has exited. `port` is from
    `address.check`.
    """
    from mjx_dher.viewer import address

    place = str(subprocesses.PACKAGE.parent)  # this package need not be installed
    code = f"import sys; sys.path.append({place!r}); from mjx_dher.__main__ import main; sys.exit(main())"
    command = (sys.executable, "-c", code, "view", str(folder), "--trust", "--port", str(port))
    variables = {"JAX_PLATFORMS": "cpu", PARENT: str(os.getpid())}
    process: subprocess.Popen[str] | None = None
    has_ended = False
    with contextlib.ExitStack() as stack:

        def after_epoch() -> None:
            nonlocal process, has_ended
            if process is None:
                process = stack.enter_context(subprocesses.started(command, variables))
                console.print(f"viewer: {address.address(Page().host, port)} (in a moment)")
            elif not has_ended and process.poll() is not None:
                has_ended = True
                failure = subprocesses.answer(process).failure or "it was closed"
                console.print(f"the viewer has ended ({failure}); the run continues")

        yield after_epoch


def _maker(engine: str | None) -> Callable[[Any], Any]:
    """Function that makes a source's environment, with physics on one core if possible, because it has only one state."""

    def make(source: Any) -> Any:
        arguments = to_arguments(source.env_kwargs)
        if engine is None and source.env in envs.list_envs():
            return envs.make(source.env, engine="native", **{"num_threads": 1, **arguments})
        return envs.make(source.env, engine=engine or "auto", **arguments)

    return make
