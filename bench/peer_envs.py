"""Tasks of Brax, MuJoCo Playground and JaxGCRL through `from_brax`. Needs a virtual environment with these packages.

The slow test looks for it as `peer_envs` in the user's cache folder. It needs `pip install -e .` and these two lines:

pip install brax==0.14.2 playground==0.2.0
pip install --no-deps jaxgcrl==0.2.8  # it asks for JAX 0.4, and its environments run with later ones

python train.py check --env bench.peer_envs:jaxgcrl_reacher
python train.py --env bench.peer_envs:jaxgcrl_reacher --num-envs 64 --cycles-per-epoch 10 --batch-size 256 \\
    --hidden-sizes 64 64 --total-steps 320000
"""

import contextlib
import importlib.util
import sys
import types
from pathlib import Path
from unittest import mock

import jax.numpy as jnp
import mujoco

from mjx_dher.envs.brax import BraxEnv, from_brax


def brax_reacher(episode_length: int = 50) -> BraxEnv:
    """Brax's Reacher. The observation contains the target, and the tip minus the target."""
    from brax.envs import get_environment

    env = get_environment("reacher", backend="generalized")
    return from_brax(
        env,
        achieved=lambda state: state.obs[8:11] + state.pipeline_state.x.pos[2],
        goal=lambda state: state.pipeline_state.x.pos[2],
        observe=lambda state: jnp.concatenate([state.obs[:4], state.obs[6:8]]),
        threshold=0.05,
        episode_length=episode_length,
    )


def playground_reacher(episode_length: int = 100) -> BraxEnv:
    """Playground's ReacherEasy with MJX: the finger should reach the target geom."""
    with mock.patch.object(mujoco, "__version__", "9"):  # it compares versions as texts
        from mujoco_playground import dm_control_suite

        env = dm_control_suite.load("ReacherEasy", config_overrides={"impl": "jax"})
    finger, target = (mujoco.mj_name2id(env.mj_model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in ("finger", "target"))
    return from_brax(
        env,
        achieved=lambda state: state.data.geom_xpos[finger],
        goal=lambda state: state.data.geom_xpos[target],
        observe=lambda state: jnp.concatenate([state.data.qpos, state.data.qvel, state.data.geom_xpos[finger]]),
        threshold=0.05,
        episode_length=episode_length,
    )


def jaxgcrl_reacher(episode_length: int = 50) -> BraxEnv:
    """JaxGCRL's Reacher, which names the goal's indices in its observation."""
    return _jaxgcrl(_module("reacher").Reacher(), episode_length)


def jaxgcrl_arm(name: str = "arm_push_easy", episode_length: int | None = None) -> BraxEnv:
    """One of JaxGCRL's arm tasks; `name` is its module."""
    kind = getattr(_module(f"manipulation.{name}"), name.title().replace("_", ""))
    root = _root()
    kind = type(kind.__name__, (kind,), {"_get_xml_path": lambda self: root / super(kind, self)._get_xml_path()})
    env = kind()
    return _jaxgcrl(env, episode_length or env.episode_length)


def _jaxgcrl(env, episode_length: int) -> BraxEnv:
    indices = env.goal_indices
    return from_brax(
        env,
        achieved=lambda state: state.obs[indices],
        goal=lambda state: state.obs[env.state_dim :],
        observe=lambda state: state.obs[: env.state_dim],
        threshold=getattr(env, "goal_reach_thresh", 0.1),
        episode_length=episode_length,
    )


def _root() -> Path:
    """Folder of JaxGCRL, which is not imported: its agents need modules that Brax no longer has."""
    spec = importlib.util.find_spec("jaxgcrl")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError("jaxgcrl is not installed; the first lines of bench/peer_envs.py have the command")
    return Path(spec.submodule_search_locations[0])


def _module(name: str):
    """A module of JaxGCRL's environments."""
    root = _root() / "envs"
    for package, path in (("gcrl_envs", root), ("gcrl_envs.manipulation", root / "manipulation")):
        if package not in sys.modules:
            sys.modules[package] = types.ModuleType(package)
            sys.modules[package].__path__ = [str(path)]
    with contextlib.suppress(KeyError):
        return sys.modules[f"gcrl_envs.{name}"]
    return importlib.import_module(f"gcrl_envs.{name}")
