"""docs/api.md is what docs/make_api.py makes of the source."""

import importlib.util
import subprocess
import sys

import pytest
from conftest import ROOT

import mjx_dher

spec = importlib.util.spec_from_file_location("make_api", ROOT / "docs" / "make_api.py")
make_api = importlib.util.module_from_spec(spec)
spec.loader.exec_module(make_api)
NAMES = [name for names in make_api.MODULES.values() for name in names]


def test_the_page_is_current():
    if make_api.PAGE.read_text() != make_api.page():
        pytest.fail("docs/api.md is not current; run: python docs/make_api.py")


def test_it_names_every_module_that_the_package_does_and_no_private_name():
    modules = {name for name in mjx_dher.__all__ if type(getattr(mjx_dher, name)) is type(mjx_dher)}
    assert modules <= set(NAMES)
    headings = [line.split("`")[1] for line in make_api.page().splitlines() if line.startswith(("### ", "#### "))]
    assert {"replay.add", "samplers.weighted", "policy.Policy.__call__", "envs.base.GoalEnv.step"} <= set(headings)
    assert not [name for name in headings if "._" in name.replace(".__call__", "")]


def section(source, tmp_path, monkeypatch):
    (tmp_path / "mjx_dher").mkdir()
    (tmp_path / "mjx_dher" / "made.py").write_text(source)
    monkeypatch.setattr(make_api, "ROOT", tmp_path)
    monkeypatch.setattr(make_api, "MODULES", {"Title": ("made",)})
    return make_api.page().split("## made\n\n")[1]


SOURCE = '''
"""A module."""

# what it counts
LEAST = 1  # at least
_HIDDEN = 2


@struct.dataclass
class Pair:
    """Two numbers."""

    first: Array  # [B]
    second: Array = 0  # type: ignore[misc]
    """Said below."""

    def total(self) -> Array:
        """[B] their sum."""
        return self.first + self.second

    def bare(self, by: float): ...


def function(
    x: Array,
    flag: bool = False,
) -> Array:
    """What it does.

    Args:
      x: [B] of something,
        or other.
      flag: whether.

    Returns:
      As many.

    Raises:
      ValueError: never.
    """


def _hidden(): ...
'''
SECTION = '''
`mjx_dher.made`: A module.

```python
# what it counts
LEAST = 1  # at least
```

### `made.Pair`

```python
@struct.dataclass
class Pair:
    first: Array  # [B]
    second: Array = 0
    """Said below."""
    def bare(self, by: float): ...
```

Two numbers.

#### `made.Pair.total`

```python
def total(self) -> Array:
```

[B] their sum.

### `made.function`

```python
def function(
    x: Array,
    flag: bool = False,
) -> Array:
```

What it does.

**Args**

- `x`: [B] of something,
  or other.
- `flag`: whether.

**Returns**

As many.

**Raises**

- `ValueError`: never.
'''


def test_a_module_s_section(tmp_path, monkeypatch):
    assert section(SOURCE.lstrip(), tmp_path, monkeypatch) == SECTION.lstrip()


def test_a_public_name_without_a_docstring_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"made\.f has no docstring"):
        section('"""A module."""\n\n\ndef f(): ...\n', tmp_path, monkeypatch)


def test_it_needs_nothing_but_python():
    code = "import runpy, sys; runpy.run_path('docs/make_api.py'); assert not {'jax', 'numpy', 'mjx_dher'} & set(sys.modules)"
    subprocess.run([sys.executable, "-I", "-c", code], cwd=ROOT, check=True)
