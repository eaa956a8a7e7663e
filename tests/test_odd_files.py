"""Files of a run that are archives NumPy cannot open, or that are no files, and sizes that no device can index."""

import os

import numpy as np
import pytest
from conftest import refuses
from test_export import random_policy, save_run

import mjx_dher
from mjx_dher import cli
from mjx_dher.config import Config, HParams
from mjx_dher.policy import from_arrays
from mjx_dher.runs.folder import results
from mjx_dher.system.files import FolderError
from mjx_dher.validation import validate


@pytest.fixture
def run(tmp_path):
    return save_run(tmp_path / "run", random_policy())


@pytest.mark.parametrize(("offset", "bit"), [(6, 0x41), (8, 0x01), (10, 0x08)], ids=["version", "password", "method"])
def test_an_archive_that_cannot_be_opened_is_damaged(offset, bit, run, capsys):
    file = run / "policy.npz"
    content = bytearray(file.read_bytes())
    content[content.rindex(b"PK\x01\x02") + offset] ^= bit
    file.write_bytes(content)
    with refuses("policy.npz", error=FolderError):
        mjx_dher.load_policy(run)
    assert cli.main(["eval", str(run)]) == 2
    assert "policy.npz" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["config.json", "policy.npz"])
def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(name, run, capsys):
    (run / name).unlink()
    os.mkfifo(run / name)
    assert cli.main(["eval", str(run)]) == 2
    assert f"{run / name} is" in capsys.readouterr().err


def test_a_pipe_in_the_place_of_a_result_is_not_waited_for(run):
    os.mkfifo(run / "result.json")
    with refuses("result.json", error=FolderError):
        results.read_result(run)


def arrays_of(folder):
    with np.load(folder / "policy.npz") as file:
        return {name: file[name] for name in file.files}


def test_a_policy_that_would_be_gigabytes_is_rejected_before_it_is_unpacked(run, monkeypatch):
    np.savez_compressed(run / "policy.npz", **arrays_of(run), layer9_kernel=np.zeros((1000, 3000), np.float32))
    monkeypatch.setattr(np.lib.format, "read_array", lambda *args, **kwargs: pytest.fail("unpacked"))
    with refuses("policy.npz", error=FolderError):
        mjx_dher.load_policy(run)


@pytest.mark.parametrize("name", ["layer0_kernel", "layer0_bias", "layer1_kernel"])
def test_weights_that_make_an_action_nan_are_rejected(run, name):
    arrays = arrays_of(run)
    from_arrays(arrays)
    with refuses("NaN"):
        from_arrays({**arrays, name: np.full_like(arrays[name], 3e38)})


def test_batches_that_no_device_can_index_are_refused():
    config = Config(batch_size=10**7, replay_size=10**8, updates_per_cycle=1000, target_period=1000)
    with refuses("batch_size", 2147483, "target_period", 1000):
        validate(config, HParams(), 50)
