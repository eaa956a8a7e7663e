"""The kernels for Hopper GPUs. Without such a GPU stand-ins read and write what they do."""

import dataclasses
import functools
import importlib.util
import re
import subprocess
import sys

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import HParams, envs, learners, presets
from mjx_dher.hopper import gradients as hopper
from mjx_dher.learners import ddpg
from mjx_dher.networks import Networks, mlp
from mjx_dher.runs.program.loop import state_template
from mjx_dher.trainer import make_train
from mjx_dher.types import Batch
from probes import spec_of

OBSERVATION, GOAL, SIZE = 25, 3, 256
HPARAMS = HParams(action_l2=0.7)
BOUNDS = (-1.0 / (1.0 - HPARAMS.gamma), 0.0)
HOPPER = getattr(jax.devices()[0], "compute_capability", None) == "9.0"


def networks(dtype, action_size):
    return mlp(action_size, (256, 256, 256), dtype)


@functools.partial(jax.jit, static_argnums=0)
def case(action_size, seed):
    """Parameters and targets whose biases are not zero, and a normalized batch."""
    keys = jax.random.split(jax.random.key(seed), 7)

    default = networks(jnp.float32, action_size)
    learner = ddpg.DDPG(spec_of(OBSERVATION, GOAL, action_size), default, default)

    def params(key):
        fresh = learner.init(key).params
        return jax.tree.map(lambda x: x + 0.05 * jax.random.normal(jax.random.fold_in(key, x.size), x.shape), fresh)

    batch = Batch(
        observation=jax.random.normal(keys[0], (SIZE, OBSERVATION)),
        next_observation=jax.random.normal(keys[1], (SIZE, OBSERVATION)),
        desired_goal=jax.random.normal(keys[2], (SIZE, GOAL)),
        action=jax.random.uniform(keys[3], (SIZE, action_size), minval=-1.0),
        reward=-jax.random.bernoulli(keys[4], 0.7, (SIZE,)).astype(jnp.float32),
        discount=jnp.full(SIZE, HPARAMS.gamma),
        row=jnp.arange(SIZE),
    )
    return params(keys[5]), params(keys[6]), batch


def number(unit):
    """Where a kernel has a unit of a hidden layer: see `hopper.to_kernel_order`."""
    q, t, i, b = unit // 32, unit // 8 % 4, unit // 2 % 4, unit % 2
    return 32 * q + 8 * i + 2 * t + b


def read(blocks, rows):
    """Weights [rows, 256] of what `hopper.to_kernel_order` has made of them, one by one."""
    row, column = np.meshgrid(np.arange(rows), np.arange(256), indexing="ij")
    k, n = (number(row) if rows == 256 else row), number(column)
    return blocks.astype(jnp.float32)[64 * (32 * (k // 8) + n // 8) + 8 * (n % 8) + k % 8]


def rounded(x):
    return x.astype(jnp.bfloat16).astype(jnp.float32)


class Net:
    """A network as a kernel is given it."""

    def __init__(self, arguments, backward):
        *weights, b1, b2, b3, last, b4 = arguments
        self.weights = [read(w, 64 if k == 0 else 256) for k, w in enumerate(weights)]
        assert len(weights) == (5 if backward else 3)
        self.biases, self.last, self.last_bias = (b1, b2, b3), last.reshape(256, -1), b4

    def forward(self, x):
        hidden = []
        for weights, bias in zip(self.weights, self.biases):
            x = rounded(jnp.maximum(x @ weights + bias, 0.0))
            hidden.append(x)
        return hidden, x @ self.last + self.last_bias

    def backward(self, d, hidden):
        d3 = jnp.where(hidden[2] > 0, d, 0.0)
        d2 = jnp.where(hidden[1] > 0, rounded(d3) @ self.weights[3], 0.0)
        return [jnp.where(hidden[0] > 0, rounded(d2) @ self.weights[4], 0.0), d2, d3]


def with_action(x, action):
    return x.at[:, 56 : 56 + action.shape[1]].set(rounded(action))


def flat(parts):
    return [part.astype(jnp.bfloat16).reshape(-1) for part in parts]


def sums(parts):
    """Over the 16 rows of each warp."""
    return [part.reshape(-1, 16, 256).sum(axis=1).reshape(-1) for part in parts]


def critic_pass(x, next_x, reward, gamma, *arguments, launch_dims, output_dims):
    *arguments, tiles, _ = arguments
    size = 128 * tiles
    assert launch_dims == tiles * hopper.THREADS
    x, next_x = (array.reshape(size, 64).astype(jnp.float32) for array in (x, next_x))
    target_actor, target_critic = Net(arguments[:8], False), Net(arguments[8:16], False)
    critic = Net(arguments[16:], True)
    next_action = jnp.tanh(target_actor.forward(next_x)[1])
    next_q = target_critic.forward(with_action(next_x, next_action))[1][:, 0]
    value = jnp.clip(reward + gamma * next_q, -1.0 / (1.0 - gamma), 0.0)
    hidden, q = critic.forward(x)
    slope = 2.0 / size * (q - value[:, None])
    d = critic.backward(slope * critic.last[:, 0], hidden)
    found = [*flat(hidden[:2]), *flat(d), *sums([*d, hidden[2] * slope]), q[:, 0], value]
    assert [len(part) for part in found] == list(output_dims.values())
    return found


def actor_pass(x, action_l2, *arguments, launch_dims, output_dims):
    *arguments, critic_action, tiles, action_size = arguments
    size = 128 * tiles
    x = x.reshape(size, 64).astype(jnp.float32)
    actor, critic = Net(arguments[:10], True), Net(arguments[10:], True)
    hidden, z = actor.forward(x)
    action = jnp.tanh(z)
    of_critic, q = critic.forward(with_action(x, action))
    d = rounded(critic.backward(jnp.full((size, 1), -1.0 / size) * critic.last[:, 0], of_critic)[0])
    slope = d @ critic_action.reshape(action_size, 256).T
    slope = (slope + 2.0 * action_l2 / (size * action_size) * action) * (1.0 - action**2)
    d = actor.backward(slope @ actor.last.T, hidden)
    four = lambda array: jnp.pad(array, ((0, 0), (0, 4 - action_size))).reshape(-1)  # noqa: E731
    found = [*flat(hidden), *flat(d), *sums(d), q[:, 0], four(action), four(slope)]
    assert [len(part) for part in found] == list(output_dims.values())
    return found


def errors(found, exact):
    """By leaf, the norm of the difference relative to that of the exact gradient."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True)
    return np.array([float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b)) for a, b in pairs])


@functools.cache
def of_xla(action_size, dtype, precision=None):
    """The gradients of a case, by XLA."""

    @jax.jit
    def gradients(*case):
        with jax.default_matmul_precision(precision):
            return ddpg.compute_gradients(networks(dtype, action_size), *case, BOUNDS, HPARAMS)

    return gradients


def assert_as_good_as_xla(found, action_size, cases):
    """Gradients and losses, of several cases, are as near to those in float32 as XLA's in bfloat16 are.

    In the mean over the cases: how far off the mean of four numbers is, such as the gradient of the policy's last bias, is
    luck in any one.
    """
    mine, theirs = [], []
    for one, case_ in zip(found, cases, strict=True):
        exact = of_xla(action_size, jnp.float32, "highest")(*case_)
        jax.tree.map(lambda a, b: np.testing.assert_equal((a.shape, a.dtype), (b.shape, b.dtype)), one, exact)
        mine.append(errors(one, exact))
        theirs.append(errors(of_xla(action_size, jnp.bfloat16)(*case_), exact))
    assert np.all(np.mean(mine, axis=0) <= 1.5 * np.mean(theirs, axis=0) + 2e-3)
    assert np.max(mine) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("action_size", [4, 2])
def test_gradients_are_put_together(action_size, monkeypatch):
    monkeypatch.setattr(hopper, "_calls", lambda: (critic_pass, actor_pass))
    cases = [case(action_size, seed) for seed in range(3)]
    gradients = lambda *x: hopper.compute_gradients(networks(jnp.bfloat16, action_size), *x, BOUNDS, HPARAMS)  # noqa: E731
    assert_as_good_as_xla([jax.jit(gradients)(*one) for one in cases], action_size, cases)


@pytest.mark.skipif(not HOPPER, reason="needs an NVIDIA H100 or H200")
@pytest.mark.parametrize("action_size", [4, pytest.param(2, marks=pytest.mark.slow)])
def test_kernels_compute_gradients(action_size):
    cases = [case(action_size, seed) for seed in range(3)]
    together = jax.tree.map(lambda *x: jnp.stack(x), *cases)
    gradients = lambda *x: hopper.compute_gradients(networks(jnp.bfloat16, action_size), *x, BOUNDS, HPARAMS)  # noqa: E731
    found = jax.jit(jax.vmap(gradients))(*together)
    lanes = [jax.tree.map(lambda x, lane=lane: x[lane], found) for lane in range(len(cases))]
    assert_as_good_as_xla(lanes, action_size, cases)


def test_kernels_compile(tmp_path):
    """To a Hopper GPU's instructions, which takes no GPU; in a process of its own, because it sets what all kernels get."""
    program = f"""
import warp as wp
from mjx_dher.hopper import kernels
wp.config.cuda_arch_suffix = "a"
for kernel in (kernels.critic_pass, kernels.actor_pass):
    kernel.module.options["block_dim"] = 384
    wp.compile_aot_module(kernel.module, arch=90, module_dir={str(tmp_path)!r}, use_ptx=True)
"""
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    for path in tmp_path.glob("*.ptx"):
        code = path.read_text()
        assert ".target sm_90a" in code
        assert len(re.findall(r"wgmma\.mma_async\.sync\.aligned\.m64n256k16", code)) == 36
        assert code.count("setmaxnreg") == 2
    assert len(list(tmp_path.glob("*.ptx"))) == 2


STATIC = dataclasses.replace(presets.preset("paper", "push").config, learner_dtype="bfloat16", learner_kernels="hopper")


class Device:
    def __init__(self, capability):
        self.compute_capability, self.device_kind = capability, "NVIDIA of " + capability


@pytest.mark.parametrize(
    ("changes", "spec", "capability", "parts"),
    [
        ({"learner_dtype": "float32"}, spec_of(25, 3, 4), "9.0", ["learner_dtype bfloat16", "is float32"]),
        ({"hidden_sizes": (256, 256)}, spec_of(25, 3, 4), "9.0", ["hidden_sizes (256, 256, 256)", "are (256, 256)"]),
        ({"batch_size": 1000}, spec_of(25, 3, 4), "9.0", ["batch_size", "256 divides", "is 1000"]),
        ({}, spec_of(54, 3, 4), "9.0", ["56", "observation and goal", "4 of an action", "has 57 and 4"]),
        ({}, spec_of(25, 3, 5), "9.0", ["56", "observation and goal", "4 of an action", "has 28 and 5"]),
        ({}, spec_of(25, 3, 4, reward_range=(0.0, 1.0)), "9.0", ["reward_range", "(0.0, 1.0)"]),
        ({}, spec_of(25, 3, 4, ends=True), "9.0", ["ends"]),
        ({}, spec_of(25, 3, 4), "8.0", ["H100 or H200", "NVIDIA of 8.0"]),
    ],
)
def test_what_they_lack_is_named(changes, spec, capability, parts, monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: [Device(capability)])
    reason = hopper.unsupported_reason(dataclasses.replace(STATIC, **changes), spec)
    assert all(part in reason for part in parts), reason


@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp-lang")
def test_they_lack_nothing_on_such_a_gpu(monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: [Device("9.0")])
    assert hopper.unsupported_reason(STATIC, spec_of(25, 3, 4)) is None


@pytest.mark.skipif(HOPPER, reason="can use them")
def test_kernels_that_cannot_be_used_are_refused_at_once():
    env = envs.make("push", engine="native")
    with refuses("learner_kernels", "hopper", "H100", "cpu"):
        make_train(env, STATIC)
    make_train(env, dataclasses.replace(STATIC, learner_kernels="auto"))


class Bounded(nn.Module):
    """An actor of one layer."""

    action_size: int

    @nn.compact
    def __call__(self, observation, goal):
        return jnp.tanh(nn.Dense(self.action_size)(jnp.concatenate([observation, goal], axis=-1)))


def own_networks(action_size, hidden_sizes, dtype):
    """An actor of one's own, and the default critic."""

    critic = mlp(action_size, hidden_sizes, dtype).critic
    return Networks(Bounded(action_size), critic)


def test_networks_of_one_s_own_are_refused_and_auto_takes_xla_for_them(monkeypatch):
    """They know the default networks alone."""
    monkeypatch.setattr(hopper, "unsupported_reason", lambda *args: None)
    sizes = spec_of(OBSERVATION, GOAL, 4)
    with refuses("learner_kernels", "hopper", "mlp"):
        learners.make("ddpg", STATIC, sizes, own_networks)
    auto = dataclasses.replace(STATIC, learner_kernels="auto")
    assert learners.make("ddpg", auto, sizes, own_networks).compute_gradients is ddpg.compute_gradients
    assert learners.make("ddpg", auto, sizes).compute_gradients is hopper.compute_gradients


def test_the_learner_uses_them(monkeypatch):
    """`auto` takes them where they can be used, and `xla` never does."""
    asked = []

    def gradients(*args):
        asked.append(args)
        return ddpg.compute_gradients(*args)

    monkeypatch.setattr(hopper, "unsupported_reason", lambda *args: None)
    monkeypatch.setattr(hopper, "compute_gradients", gradients)
    env = envs.make("reach", engine="native")
    small = dataclasses.replace(STATIC, num_envs=2, cycles_per_epoch=1, batch_size=256, replay_size=1000)
    for kernels, uses in (("xla", False), ("auto", True), ("hopper", True)):
        program = make_train(env, dataclasses.replace(small, learner_kernels=kernels))
        jax.eval_shape(program.epoch, state_template(program))
        assert bool(asked) is uses
        asked.clear()


def test_the_kernels_are_compiled_once_for_each_device():
    wp = pytest.importorskip("warp")
    found = hopper.devices()
    assert wp.get_device() in found
    assert len(found) == len({device.alias for device in found})
