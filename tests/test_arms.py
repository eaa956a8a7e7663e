"""Every arm of the bake-off learns: Reach on a CPU, arms of a group as lanes of one program."""

import dataclasses

import pytest
from conftest import ROOT

from mjx_dher import Options, presets
from mjx_dher.cli.common import make_env
from mjx_dher.sweeps import grid, tables


@pytest.mark.slow
@pytest.mark.parametrize("group", ["plain", "transitions", "errors"])
def test_arms_learn_to_reach(monkeypatch, tmp_path, group):
    """In 16,000 steps, as the preset does: 1.000 over 500 episodes with each of three seeds (README.md)."""
    monkeypatch.syspath_prepend(ROOT / "bench")
    from bakeoff_arms import ARMS, parts_of

    specs = []
    for arm in (arm for arm in ARMS if arm.group == group):
        run = presets.preset("cpu", "reach", engine="native", **parts_of("reach", arm))
        specs.append(dataclasses.replace(run, hparams=run.hparams._replace(**arm.numbers)))
    options = Options(final_episodes=100, checkpoint_every=0)
    grid.train(tmp_path, specs, make_env, options=options, lanes=len(specs))
    success = {str(trial["folder"].name): trial["final"].get("success_rate") for trial in tables.read(tmp_path)}
    assert len(success) == len(specs) == len({grid.folder_of(tmp_path, spec) for spec in specs})
    assert min(success.values()) >= 0.95, success
