"""Gradients of an update by CUDA kernels for NVIDIA's Hopper GPUs (H100, H200), in half of XLA's time.

XLA computes one layer after another and writes each layer's activations to memory and reads them again, which takes longer than
the matrix products. The kernels keep activations in registers; XLA computes the products that are weights' gradients.
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
from mjx_dher.learners.common import Losses, Params
from mjx_dher.networks import Networks
from mjx_dher.types import Array, Batch, EnvSpec, PyTree

_CAPABILITY = "9.0"  # of Hopper GPUs

_BF16, _F32 = jnp.bfloat16, jnp.float32
_UNIT_DIGITS = (8, 4, 4, 2)  # q, t, i, b of a unit's number: see `to_kernel_order`


def unsupported_reason(config: Config, spec: EnvSpec) -> str | None:
    """Returns the first requirement of these kernels that a run does not meet, or None.

    Args:
      config: of the run.
      spec: of the environment.
    """
    num_inputs = sum(leaf.shape[-1] for leaf in jax.tree.leaves(spec.observation)) + spec.goal_size
    device = jax.devices()[0]
    requirements = (
        (spec.reward_range == (-1.0, 0.0), f"a reward_range of (-1, 0); it is {spec.reward_range}"),
        (not spec.ends, "episodes that do not end early; ends is True"),
        (config.n_step == 1, f"n_step 1; it is {config.n_step}"),
        (config.learner_dtype == "bfloat16", f"learner_dtype bfloat16; it is {config.learner_dtype}"),
        (config.hidden_sizes == (WIDTH,) * 3, f"hidden_sizes {(WIDTH,) * 3}; they are {config.hidden_sizes}"),
        (
            config.batch_size % (ROWS * BLOCKS) == 0,
            f"a batch_size that {ROWS * BLOCKS} divides; it is {config.batch_size}",
        ),
        (
            num_inputs <= ACTION and spec.action_size <= MAX_ACTION,
            f"at most {ACTION} numbers of observation and goal and {MAX_ACTION} of an action; this environment has {num_inputs}"
            f" and {spec.action_size}",
        ),
        (
            getattr(device, "compute_capability", None) == _CAPABILITY,
            f"an NVIDIA H100 or H200; JAX runs on {device.device_kind} here",
        ),
        (importlib.util.find_spec("warp") is not None, 'the package warp-lang: pip install -e ".[cuda]"'),
    )
    return next((reason for met, reason in requirements if not met), None)


def to_kernel_order(weights: Array) -> Array:
    """Returns weights [K, 256] as [K * 256] bfloat16 in the order in which the kernels read them.

    K is 256 units or 64 inputs. The result consists of matrices of 8 columns by 8 rows; matrices of the same rows are
    neighbours. Columns, and rows that are units, are in the order in which a thread holds them: unit 32 q + 8 t + 2 i + b comes
    as number 32 q + 8 i + 2 t + b. Thread t holds columns 8 j + 2 t and 8 j + 2 t + 1 of a product: eight units in a row.
    """
    weights = weights.astype(_BF16)
    if weights.shape[0] == WIDTH:
        return weights.reshape(*_UNIT_DIGITS, *_UNIT_DIGITS).transpose(0, 2, 4, 6, 5, 7, 1, 3).reshape(-1)
    return weights.reshape(-1, 8, *_UNIT_DIGITS).transpose(0, 2, 4, 3, 5, 1).reshape(-1)


def _layers(network: PyTree) -> list[tuple[Array, Array]]:
    layers = network["params"]
    return [(layers[f"Dense_{i}"]["kernel"], layers[f"Dense_{i}"]["bias"]) for i in range(4)]


def _network_arguments(network: PyTree, num_inputs: int, backward: bool) -> list[Array]:
    (first, b1), (second, b2), (third, b3), (last, b4) = _layers(network)
    action = jnp.pad(first[num_inputs:], ((0, INPUTS - ACTION - (first.shape[0] - num_inputs)), (0, 0)))
    padded = jnp.concatenate([jnp.pad(first[:num_inputs], ((0, ACTION - num_inputs), (0, 0))), action])
    weights = [padded, second, third] + ([third.T, second.T] if backward else [])
    return [*map(to_kernel_order, weights), b1, b2, b3, last.reshape(-1), b4]


def _input_columns(batch: Batch, observation: Array, action: Array | None) -> Array:
    """Returns the first layer's inputs [B, 64]: observation, goal, zeros and, from column 56 on, the action or zeros."""

    def place(x: Array, column: int) -> Array:
        return jnp.pad(x, ((0, 0), (column, INPUTS - column - x.shape[1])))

    columns = place(observation, 0) + place(batch.desired_goal, observation.shape[1])
    return (columns if action is None else columns + place(action, ACTION)).astype(_BF16)


def _scalar(number: Array | float) -> Array:
    return jnp.reshape(jnp.asarray(number, _F32), (1,))


def _output_sizes(size: int, rows: str, warp_sums: str) -> dict[str, int]:
    """Returns the lengths of outputs: `rows` are [B * 256], `warp_sums` are sums over the 16 rows of each warp."""
    return dict.fromkeys(rows.split(), size * WIDTH) | dict.fromkeys(warp_sums.split(), size // 16 * WIDTH)


def _matrix(array: Array) -> Array:
    return array.reshape(-1, WIDTH)


def _products(left: Array, right: Array) -> Array:
    """Returns the sum of outer products [I, J] float32 of the rows of [B, I] and [B, J]."""
    return jax.lax.dot_general(left, right, (((0,), (0,)), ((), ())), preferred_element_type=_F32)


def _total(warp_sums: Array) -> Array:
    """Returns sums [256] over the batch."""
    return jnp.sum(_matrix(warp_sums), axis=0)


def _network_gradients(
    first: Array, h: tuple[Array, Array], d: tuple[Array, Array], last: Array, biases: list[Array]
) -> PyTree:
    """Returns a network's gradients, given those of its `first` and `last` layer's weights and of all `biases`.

    Activations `h` of the first two hidden layers and gradients `d` at the last two are [B * 256].
    """
    weights = [first, *(_products(_matrix(left), _matrix(right)) for left, right in zip(h, d)), last]
    return {"params": {f"Dense_{i}": {"kernel": w, "bias": b} for i, (w, b) in enumerate(zip(weights, biases))}}


@functools.cache
def _calls() -> tuple[Any, Any]:
    """Returns the two kernels as functions of JAX, compiled: nothing can be compiled while XLA records a graph."""
    from mjx_dher.hopper.kernels import actor_pass, critic_pass
    from mjx_dher.system.warp_setup import prepare, wp

    prepare()
    with concurrent.futures.ThreadPoolExecutor() as pool:
        modules = [(kernel.module, device) for kernel in (critic_pass, actor_pass) for device in devices()]
        for loading in [pool.submit(module.load, device, THREADS) for module, device in modules]:
            loading.result()
    make = functools.partial(wp.jax_kernel, block_dim=THREADS, module_preload_mode=wp.JaxModulePreloadMode.NONE)
    return make(critic_pass, num_outputs=11), make(actor_pass, num_outputs=12)


def devices() -> list[Any]:
    """Returns Warp's own device and those of JAX on this host, each once. They have no hash, and so no set."""
    from mjx_dher.system.warp_setup import wp

    local = [wp.device_from_jax(each) for each in jax.local_devices() if each.platform == "gpu"]
    return list({device.alias: device for device in (wp.get_device(), *local)}.values())


def compute_gradients(
    networks: Networks, params: Params, target: Params, batch: Batch, bounds: Any, hparams: HParams
) -> tuple[Params, Losses]:
    """Computes `ddpg.compute_gradients`, hidden layers in bfloat16, for runs of which `unsupported_reason` says None.

    Rounds less often than XLA does: a layer's bias is added in float32.
    """
    del networks, bounds  # known: see `unsupported_reason`
    size, action_size = batch.action.shape
    num_inputs = batch.observation.shape[1] + batch.desired_goal.shape[1]
    x = _input_columns(batch, batch.observation, batch.action)
    critic = _network_arguments(params.critic, num_inputs, backward=True)
    critic_gradients, q, td_error = _critic_gradients(x, critic, target, batch, hparams)
    actor_gradients, q_pi, action = _actor_gradients(x, critic, params, batch, hparams)
    losses = Losses(
        critic_loss=jnp.mean(jnp.square(td_error)),
        actor_loss=-jnp.mean(q_pi) + hparams.action_l2 * jnp.sum(jnp.square(action)) / (size * action_size),
        q_mean=jnp.mean(q),
    )
    return Params(actor=actor_gradients, critic=critic_gradients), losses


def _critic_gradients(
    x: Array, critic: list[Array], target: Params, batch: Batch, hparams: HParams
) -> tuple[PyTree, Array, Array]:
    """Returns the critic's gradients, its values [B] and these less their targets [B].

    `x` [B, 64] is of `_input_columns`, `critic` of `_network_arguments`.
    """
    size, action_size = batch.action.shape
    num_inputs = batch.observation.shape[1] + batch.desired_goal.shape[1]
    tiles = size // ROWS
    h1, h2, d1, d2, d3, sum1, sum2, sum3, last, q, q_target = _calls()[0](
        x.reshape(-1),
        _input_columns(batch, batch.next_observation, None).reshape(-1),
        batch.reward.astype(_F32),
        _scalar(hparams.gamma),
        *_network_arguments(target.actor, num_inputs, backward=False),
        *_network_arguments(target.critic, num_inputs, backward=False),
        *critic,
        tiles,
        action_size,
        launch_dims=tiles * THREADS,
        output_dims=_output_sizes(size, "h1 h2 d1 d2 d3", "sum1 sum2 sum3 sum4") | {"q_out": size, "target_out": size},
    )
    td_error = q - q_target
    first = _products(x, _matrix(d1))
    gradients = _network_gradients(
        jnp.concatenate([first[:num_inputs], first[ACTION : ACTION + action_size]]),
        (h1, h2),
        (d2, d3),
        _total(last)[:, None],
        [_total(sum1), _total(sum2), _total(sum3), jnp.mean(2.0 * td_error)[None]],
    )
    return gradients, q, td_error


def _actor_gradients(
    x: Array, critic: list[Array], params: Params, batch: Batch, hparams: HParams
) -> tuple[PyTree, Array, Array]:
    """Returns the actor's gradients, the critic's values [B] of its actions, and these actions [B * 4], padded by zeros.

    Takes what `_critic_gradients` takes, except `params` in place of the target networks.
    """
    size, action_size = batch.action.shape
    num_inputs = batch.observation.shape[1] + batch.desired_goal.shape[1]
    tiles = size // ROWS
    h1, h2, h3, d1, d2, d3, sum1, sum2, sum3, q_pi, action, slope = _calls()[1](
        x.reshape(-1),
        _scalar(hparams.action_l2),
        *_network_arguments(params.actor, num_inputs, backward=True),
        *critic,
        _layers(params.critic)[0][0][num_inputs:].reshape(-1),
        tiles,
        action_size,
        launch_dims=tiles * THREADS,
        output_dims=_output_sizes(size, "h1 h2 h3 d1 d2 d3", "sum1 sum2 sum3")
        | {"q_out": size, "action_out": size * MAX_ACTION, "slope_out": size * MAX_ACTION},
    )
    slope = slope.reshape(size, MAX_ACTION)[:, :action_size]
    gradients = _network_gradients(
        # Not of all columns: XLA would copy both factors to make one product of this and the critic's.
        _products(x[:, : -(-num_inputs // 8) * 8], _matrix(d1))[:num_inputs],
        (h1, h2),
        (d2, d3),
        _products(_matrix(h3), slope.astype(_BF16)),
        [_total(sum1), _total(sum2), _total(sum3), jnp.sum(slope, axis=0)],
    )
    return gradients, q_pi, action
