"""Warp's cache of compiled kernels, where it cannot be used."""

import os
import subprocess
import sys

import pytest
from conftest import ROOT

from mjx_dher.system.warp_setup import load, wp


def test_without_a_folder_to_keep_kernels_in_a_warning_says_what_it_costs(tmp_path):
    (tmp_path / "file").touch()
    code = (
        "from mjx_dher.system.warp_setup import prepare, wp; import os; prepare();"
        "print(os.path.isdir(wp.config.kernel_cache_dir), wp.config.kernel_cache_dir)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file" / "cache")},
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    is_there, folder = run.stdout.split()
    assert "Warp cannot cache compiled kernels" in run.stderr
    assert "set WARP_CACHE_PATH to another folder" in run.stderr
    assert is_there == "True"
    assert not os.path.exists(folder)  # it went with the program


@pytest.mark.parametrize("damage", ["not code", ""])
@pytest.mark.parametrize("suffix", [".o", ".meta"])
def test_kernels_whose_files_are_damaged_are_compiled_anew(suffix, damage, tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))

    @wp.kernel(module="unique", enable_backward=False)
    def double(x: wp.array(dtype=float)):
        x[0] = 2.0 * x[0]

    double.module.unload()  # of the other cases, whose kernel is the same
    load(double.module)
    double.module.unload()
    (file,) = [path for path in tmp_path.rglob("*") if path.suffix == suffix]
    file.write_text(damage)
    with pytest.warns(UserWarning, match="kernels"):
        load(double.module)
    x = wp.array([3.0], dtype=float)
    wp.launch(double, dim=1, inputs=[x])
    assert x.numpy()[0] == 6.0


def test_what_cannot_be_compiled_is_no_damage(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))

    @wp.kernel(module="unique", enable_backward=False)
    def wrong(x: wp.array(dtype=float)):
        x[0] = wp.nothing_of_that_name(x[0])

    with pytest.raises(AttributeError, match="nothing_of_that_name"):
        load(wrong.module)
