"""Loggers to TensorBoard and to Weights & Biases, with the interface of `loggers.Sink`."""

import os
from pathlib import Path
from typing import Any

from mjx_dher.runs.folder import fingerprint
from mjx_dher.runs.folder.loggers import COUNTS, Sink
from mjx_dher.runs.folder.run_folder import named


class TensorBoardSink:
    """Event file for TensorBoard in `path`, over environment steps. Needs the extra `tensorboard`."""

    def __init__(self, path: Path, env_steps: int = 0):
        from tensorboardX import SummaryWriter

        self._writer = SummaryWriter(str(path), purge_step=env_steps + 1 if env_steps else None)

    def write(self, row: dict[str, Any]) -> None:
        for name, value in row.items():
            if name not in COUNTS:
                self._writer.add_scalar(name, value, row["env_steps"])
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class WandbSink:
    """A Weights & Biases run, configured by its environment variables (WANDB_MODE=offline, WANDB_PROJECT, ...). Extra `wandb`.

    The run folder holds offline logs, and a resumed run continues the same W&B run. Raises ValueError if W&B cannot start.
    """

    def __init__(self, folder: Path):
        import wandb

        from mjx_dher.runs.folder import reading

        self._folder = folder
        content = reading.read_config(folder)
        run = reading.to_spec(folder, content)
        # A resumed run keeps its id, which therefore excludes settings that may change.
        described = {name: x for name, x in reading.identity_of(content, run).items() if name not in fingerprint.MAY_CHANGE}
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "mjx-dher"),
                name=folder.absolute().name,
                id=fingerprint.sha256_of([folder.absolute().name, described])[:16],
                resume="allow",
                dir=folder,
                config={**fingerprint.settings(run), "seed": run.seed, "engine": content["physics"]},
                settings=wandb.Settings(silent=True),
            )
        except (wandb.Error, ValueError) as error:  # no key, no answer, or a wrong variable
            reason = "; ".join(map(str.strip, str(error).splitlines()[:3]))
            raise ValueError(f"log wandb cannot start ({reason}); WANDB_MODE=offline needs no account") from error

    def write(self, row: dict[str, Any]) -> None:
        with named(self._folder, "log wandb"):
            self._run.log(row, step=row["epoch"], commit=True)

    def close(self) -> None:
        with named(self._folder, "log wandb"):
            self._run.finish()


def open_sink(log: str, folder: Path, env_steps: int = 0) -> Sink:
    """Opens the log "tensorboard" or "wandb" of the run in `folder`, after `env_steps` environment steps."""
    return TensorBoardSink(folder / "tensorboard", env_steps) if log == "tensorboard" else WandbSink(folder)
