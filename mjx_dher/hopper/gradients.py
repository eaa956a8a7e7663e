"""An update's gradients by kernels of its own, for NVIDIA's Hopper GPUs (H100, H200): in half of XLA's time.

XLA computes a layer after another and writes each one's activations to memory and reads them again, which takes longer than
the products. Here they stay in registers (`kernels`); XLA is left with the products that are weights' gradients.
"""

from __future__ import annotations

import concurrent.futures
import functools
import importlib.util
from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher.config import Config, HParams
from mjx_dher.hopper.layout import ACTION, BLOCKS, INPUTS, MAX_ACTION, ROWS, THREADS, WIDTH
from mjx_dher.learners.ddpg import Losses, Networks, Params
from mjx_dher.types import Array, Batch, PyTree

_CAPABILITY = "9.0"  # of Hopper GPUs

_BF16, _F32 = jnp.bfloat16, jnp.float32
_ORDER = (8, 4, 4, 2)  # q, t, i, b of a unit: see `blocks`


def unsupported_reason(config: Config, num_inputs: int, action_size: int) -> str | None:
    """What these kernels would need for a run's gradients and do not find, or None.

    Args:
      config: of the run.
      num_inputs: numbers of observation and goal, D + G.
      action_size: A.
    """
    device = jax.devices()[0]
    needs = (
        (config.learner_dtype == "bfloat16", f"learner_dtype bfloat16; it is {config.learner_dtype}"),
        (config.hidden_sizes == (WIDTH,) * 3, f"hidden_sizes {(WIDTH,) * 3}; they are {config.hidden_sizes}"),
        (
            config.batch_size % (ROWS * BLOCKS) == 0,
            f"a batch_size that {ROWS * BLOCKS} divides; it is {config.batch_size}",
        ),
        (
            num_inputs <= ACTION and action_size <= MAX_ACTION,
            f"at most {ACTION} numbers of observation and goal and {MAX_ACTION} of an action; this environment has {num_inputs}"
            f" and {action_size}",
        ),
        (
            getattr(device, "compute_capability", None) == _CAPABILITY,
            f"an NVIDIA H100 or H200; JAX runs on {device.device_kind} here",
        ),
        (importlib.util.find_spec("warp") is not None, 'the package warp-lang: pip install -e ".[cuda]"'),
    )
    return next((need for there, need in needs if not there), None)


def blocks(weights: Array) -> Array:
    """[K * 256] bfloat16 of weights [K, 256], in the order in which the kernels read them. K is 256 units or 64 inputs.

    It consists of matrices of 8 columns by 8 rows, those of the same rows side by side. Columns, and rows that are units, are
    in the order in which a thread holds them: unit 32 q + 8 t + 2 i + b comes as number 32 q + 8 i + 2 t + b, so that the
    columns 8 j + 2 t and the next of a product, which are thread t's, are eight units in a row.
    """
    weights = weights.astype(_BF16)
    if weights.shape[0] == WIDTH:
        return weights.reshape(*_ORDER, *_ORDER).transpose(0, 2, 4, 6, 5, 7, 1, 3).reshape(-1)
    return weights.reshape(-1, 8, *_ORDER).transpose(0, 2, 4, 3, 5, 1).reshape(-1)


def _layers(network: PyTree) -> list[tuple[Array, Array]]:
    layers = network["params"]
    return [(layers[f"Dense_{i}"]["kernel"], layers[f"Dense_{i}"]["bias"]) for i in range(4)]


def _arguments(network: PyTree, num_inputs: int, backward: bool) -> list[Array]:
    (first, b1), (second, b2), (third, b3), (last, b4) = _layers(network)
    action = jnp.pad(first[num_inputs:], ((0, INPUTS - ACTION - (first.shape[0] - num_inputs)), (0, 0)))
    padded = jnp.concatenate([jnp.pad(first[:num_inputs], ((0, ACTION - num_inputs), (0, 0))), action])
    weights = [padded, second, third] + ([third.T, second.T] if backward else [])
    return [*map(blocks, weights), b1, b2, b3, last.reshape(-1), b4]


def _products(left: Array, right: Array) -> Array:
    """[B, I], [B, J] -> [I, J] float32."""
    return jax.lax.dot_general(left, right, (((0,), (0,)), ((), ())), preferred_element_type=_F32)


def _matrix(array: Array) -> Array:
    return array.reshape(-1, WIDTH)


def _sum(parts: Array) -> Array:
    """[256] of the sums over the rows of each warp."""
    return jnp.sum(_matrix(parts), axis=0)


def _gradients(first: Array, h: tuple[Array, Array], d: tuple[Array, Array], last: Array, biases: list[Array]) -> PyTree:
    """Of a network: activations `h` of the first two hidden layers and gradients `d` at the last two are [B * 256]."""
    weights = [first, *(_products(_matrix(left), _matrix(right)) for left, right in zip(h, d)), last]
    return {"params": {f"Dense_{i}": {"kernel": w, "bias": b} for i, (w, b) in enumerate(zip(weights, biases))}}


@functools.cache
def _calls() -> tuple[Any, Any]:
    """The two kernels as functions of JAX, compiled: XLA may ask for them while it records, when nothing can be compiled."""
    from mjx_dher.hopper.kernels import actor_pass, critic_pass
    from mjx_dher.host.warp_setup import prepare, wp

    prepare()
    device = wp.get_device()
    with concurrent.futures.ThreadPoolExecutor() as pool:
        for loading in [pool.submit(kernel.module.load, device, THREADS) for kernel in (critic_pass, actor_pass)]:
            loading.result()
    make = functools.partial(wp.jax_kernel, block_dim=THREADS, module_preload_mode=wp.JaxModulePreloadMode.NONE)
    return make(critic_pass, num_outputs=11), make(actor_pass, num_outputs=12)


def compute_gradients(
    networks: Networks, params: Params, target: Params, batch: Batch, hparams: HParams
) -> tuple[Params, Losses]:
    """`ddpg.compute_gradients`, hidden layers in bfloat16, for runs of which `unsupported_reason` says None.

    Rounds less often than XLA does: a layer's bias is added in float32.
    """
    del networks  # known: see `unsupported_reason`
    size, action_size = batch.action.shape
    num_inputs = batch.observation.shape[1] + batch.desired_goal.shape[1]

    def inputs(observation: Array, action: Array | None) -> Array:
        put = lambda x, at: jnp.pad(x, ((0, 0), (at, INPUTS - at - x.shape[1])))  # noqa: E731
        parts = put(observation, 0) + put(batch.desired_goal, observation.shape[1])
        return (parts if action is None else parts + put(action, ACTION)).astype(_BF16)

    x = inputs(batch.observation, batch.action)
    tiles = size // ROWS
    critic = _arguments(params.critic, num_inputs, backward=True)
    one = lambda number: jnp.reshape(jnp.asarray(number, _F32), (1,))  # noqa: E731
    rows = lambda *names: dict.fromkeys(names, size * WIDTH)  # noqa: E731
    sums = lambda *names: dict.fromkeys(names, size // 16 * WIDTH)  # noqa: E731
    critic_call, actor_call = _calls()
    launch = tiles * THREADS
    h1, h2, d1, d2, d3, sum1, sum2, sum3, last, q, value = critic_call(
        x.reshape(-1),
        inputs(batch.next_observation, None).reshape(-1),
        batch.reward.astype(_F32),
        one(hparams.gamma),
        *_arguments(target.actor, num_inputs, backward=False),
        *_arguments(target.critic, num_inputs, backward=False),
        *critic,
        tiles,
        action_size,
        launch_dims=launch,
        output_dims=rows("h1", "h2", "d1", "d2", "d3")
        | sums("sum1", "sum2", "sum3", "sum4")
        | {"q_out": size, "target_out": size},
    )
    difference = q - value
    first = _products(x, _matrix(d1))
    critic_grad = _gradients(
        jnp.concatenate([first[:num_inputs], first[ACTION : ACTION + action_size]]),
        (h1, h2),
        (d2, d3),
        _sum(last)[:, None],
        [_sum(sum1), _sum(sum2), _sum(sum3), jnp.mean(2.0 * difference)[None]],
    )
    h1, h2, h3, d1, d2, d3, sum1, sum2, sum3, q_pi, action, slope = actor_call(
        x.reshape(-1),
        one(hparams.action_l2),
        *_arguments(params.actor, num_inputs, backward=True),
        *critic,
        _layers(params.critic)[0][0][num_inputs:].reshape(-1),
        tiles,
        action_size,
        launch_dims=launch,
        output_dims=rows("h1", "h2", "h3", "d1", "d2", "d3")
        | sums("sum1", "sum2", "sum3")
        | {"q_out": size, "action_out": size * MAX_ACTION, "slope_out": size * MAX_ACTION},
    )
    slope = slope.reshape(size, MAX_ACTION)[:, :action_size]
    actor_grad = _gradients(
        # Not of all columns: XLA would copy both factors to make one product of this and the critic's.
        _products(x[:, : -(-num_inputs // 8) * 8], _matrix(d1))[:num_inputs],
        (h1, h2),
        (d2, d3),
        _products(_matrix(h3), slope.astype(_BF16)),
        [_sum(sum1), _sum(sum2), _sum(sum3), jnp.sum(slope, axis=0)],
    )
    losses = Losses(
        critic_loss=jnp.mean(jnp.square(difference)),
        actor_loss=-jnp.mean(q_pi) + hparams.action_l2 * jnp.sum(jnp.square(action)) / (size * action_size),
        q_mean=jnp.mean(q),
    )
    return Params(actor=actor_grad, critic=critic_grad), losses
