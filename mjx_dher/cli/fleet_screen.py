"""Progress over all nodes of a fleet: a live table on a terminal; elsewhere a line now and then."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rich.console import Console
from rich.live import Live
from rich.table import Table

from mjx_dher.cli.common import SECONDS_PER_LINE, clock
from mjx_dher.fleet.chunks import Told
from mjx_dher.fleet.driver import State
from mjx_dher.spec import RunSpec

ROWS = 20  # of the table: chunks that have told something last
SILENT = 300.0  # s without a word, after which a chunk is no longer shown


class FleetScreen:
    """Screen of one sweep.

    Args:
      console: to print to.
      specs: runs that are to be trained.
    """

    def __init__(self, console: Console, specs: Sequence[RunSpec]):
        self._console, self._runs = console, len(specs)
        self._steps = sum(spec.config.total_steps for spec in specs) / max(1, len(specs))  # of a run, in the mean
        self._shown: dict[str, tuple[float, Told]] = {}  # by chunk: when it was told
        self._printed = time.monotonic()
        self._before: tuple[float, float] | None = None  # when the first progress was told, and how much
        self._live: Live | None = None
        if console.is_terminal:
            self._live = Live(console=console, refresh_per_second=2)
            self._live.start()

    def show(self, state: State) -> None:
        """Shows a state of the fleet."""
        now = time.monotonic()
        self._shown |= {told.chunk: (now, told) for told in state.told}
        self._shown = {name: entry for name, entry in self._shown.items() if now - entry[0] < SILENT}
        line = self._line(state, now)
        if self._live is not None:
            self._live.update(self._table(line))
        elif now - self._printed > SECONDS_PER_LINE or state.ended == self._runs:
            self._console.print(line, soft_wrap=True, highlight=False)
            self._printed = now

    def _line(self, state: State, now: float) -> str:
        told = [entry for _, entry in self._shown.values() if entry.chunk in state.flying]
        steps = state.ended * self._steps + sum(entry.done for entry in told)
        share = min(1.0, steps / max(1.0, self._runs * self._steps))
        self._before = self._before or ((now, share) if share else None)
        eta = "not known yet"
        if self._before is not None and share > self._before[1]:
            eta = clock((now - self._before[0]) * (1 - share) / (share - self._before[1]))
        rate = sum(entry.steps_per_second for entry in told)
        nodes = len({entry.host for entry in told})
        busy = f"{len(told)} of {state.slots} tasks train on {nodes} {'host' if nodes == 1 else 'hosts'}"
        busy = busy if state.slots else "no node takes a task now"
        now_at = f"{busy}  {rate:,.0f} steps/s{_success(told)}"
        return f"{share:.0%}  {state.ended} of {self._runs} runs have ended; {now_at}  ETA {eta}"

    def _table(self, line: str) -> Table:
        table = Table("host", "runs", "epoch", "steps/s", "success", title=line, title_justify="left", expand=False)
        newest = sorted(self._shown.values(), key=lambda entry: -entry[0])
        for _, told in sorted(newest[:ROWS], key=lambda entry: (entry[1].host, entry[1].chunk)):
            success = "  ".join(f"{name} {rate:.2f}" for name, rate in told.success.items())
            table.add_row(
                told.host,
                f"{told.env}, {told.runs}",
                f"{told.epoch}/{told.num_epochs}",
                f"{told.steps_per_second:,.0f}",
                success,
            )
        if len(newest) > ROWS:
            table.add_row(f"and {len(newest) - ROWS} more", "", "", "", "")
        return table

    def close(self) -> None:
        """Ends the live table."""
        if self._live is not None:
            self._live.stop()


def _success(told: Sequence[Told]) -> str:
    """Returns the mean success of what trains now, by sampler."""
    rates: dict[str, list[float]] = {}
    for entry in told:
        for name, rate in entry.success.items():
            rates.setdefault(name, []).append(rate)
    return "".join(f"  {name} {sum(own) / len(own):.2f}" for name, own in rates.items())
