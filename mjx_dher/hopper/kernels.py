# mypy: disable-error-code="valid-type,var-annotated"
"""Warp kernels around the CUDA code in kernels.cu."""

from pathlib import Path

from mjx_dher.hopper.layout import BLOCKS, INPUTS, ROWS, THREADS, WIDTH
from mjx_dher.system.warp_setup import wp

_CONSUMERS = THREADS - 128  # threads that multiply: two warpgroups; a third warpgroup copies
_CHUNK = 64 * WIDTH  # weights in a chunk: 64 rows of a matrix
_STAGES = 5  # chunks in the ring
# Numbers of a network that stay in shared memory: three biases, the last layer's weights, [4, 256] or [256], and its bias.
_ACTOR_VECTORS = 3 * WIDTH + 4 * WIDTH + 4
_CRITIC_VECTORS = 3 * WIDTH + WIDTH + 4

_SECTIONS = dict(
    part.split("\n", 1) for part in Path(__file__).with_suffix(".cu").read_text(encoding="utf-8").split("\n//// ")[1:]
)
_NAMES = {
    "CRITIC_VECTORS": str(_CRITIC_VECTORS),
    "ACTOR_VECTORS": str(_ACTOR_VECTORS),
    "ACCUMULATORS": ", ".join(f"%{i}" for i in range(128)),
    "OPERANDS": ", ".join(f'"+f"(acc[{i}])' for i in range(128)),
    "CONSUMERS": str(_CONSUMERS),
    "THREADS": str(THREADS),
    "STAGES": str(_STAGES),
    "BLOCKS": str(BLOCKS),
    "INPUTS": str(INPUTS),
    "CHUNK": str(_CHUNK),
    "WIDTH": str(WIDTH),
    "ROWS": str(ROWS),
}


def _code(kernel: str) -> str:
    code = "".join(_SECTIONS[name] for name in ("streams", f"{kernel} source", "common", kernel))
    for name, value in _NAMES.items():
        code = code.replace(name, value)
    return code


def _shared_floats(vectors: int, masks: int) -> int:
    """Returns the size of a block's shared memory: the ring, the vectors, masks of active units, and the barriers."""
    return (_STAGES * _CHUNK * 2 + 4 * vectors + 16 * masks * _CONSUMERS + 128) // 4


_CRITIC_SHARED = wp.constant(_shared_floats(_ACTOR_VECTORS + 2 * _CRITIC_VECTORS, 3))
_ACTOR_SHARED = wp.constant(_shared_floats(_ACTOR_VECTORS + _CRITIC_VECTORS + 4 * WIDTH, 6))

_bf16 = wp.array(dtype=wp.bfloat16)
_f32 = wp.array(dtype=float)

# fmt: off


@wp.func_native(_code("critic"))
def _critic_block(
    x: _bf16, next_x: _bf16, reward: _f32, gamma: _f32, target_actor_1: _bf16, target_actor_2: _bf16, target_actor_3: _bf16,
    target_actor_b1: _f32, target_actor_b2: _f32, target_actor_b3: _f32, target_actor_w4: _f32, target_actor_b4: _f32,
    target_critic_1: _bf16, target_critic_2: _bf16, target_critic_3: _bf16, target_critic_b1: _f32, target_critic_b2: _f32,
    target_critic_b3: _f32, target_critic_w4: _f32, target_critic_b4: _f32, critic_1: _bf16, critic_2: _bf16, critic_3: _bf16,
    critic_3t: _bf16, critic_2t: _bf16, critic_b1: _f32, critic_b2: _f32, critic_b3: _f32, critic_w4: _f32, critic_b4: _f32,
    tiles: int, size: int, h1: _bf16, h2: _bf16, d1: _bf16, d2: _bf16, d3: _bf16, sum1: _f32, sum2: _f32, sum3: _f32,
    sum4: _f32, q_out: _f32, target_out: _f32,
): ...


@wp.kernel(module="unique", enable_backward=False, launch_bounds=(THREADS, 1), cluster_dim=BLOCKS, grid_stride=False)
def critic_pass(
    x: _bf16, next_x: _bf16, reward: _f32, gamma: _f32, target_actor_1: _bf16, target_actor_2: _bf16, target_actor_3: _bf16,
    target_actor_b1: _f32, target_actor_b2: _f32, target_actor_b3: _f32, target_actor_w4: _f32, target_actor_b4: _f32,
    target_critic_1: _bf16, target_critic_2: _bf16, target_critic_3: _bf16, target_critic_b1: _f32, target_critic_b2: _f32,
    target_critic_b3: _f32, target_critic_w4: _f32, target_critic_b4: _f32, critic_1: _bf16, critic_2: _bf16, critic_3: _bf16,
    critic_3t: _bf16, critic_2t: _bf16, critic_b1: _f32, critic_b2: _f32, critic_b3: _f32, critic_w4: _f32, critic_b4: _f32,
    tiles: int, size: int, h1: _bf16, h2: _bf16, d1: _bf16, d2: _bf16, d3: _bf16, sum1: _f32, sum2: _f32, sum3: _f32,
    sum4: _f32, q_out: _f32, target_out: _f32,
):
    """Computes the critic's targets and values, and the factors of its gradients."""
    _ = wp.tile_empty(shape=_CRITIC_SHARED, dtype=float, storage="shared")  # reserves the block's shared memory
    _critic_block(
        x, next_x, reward, gamma, target_actor_1, target_actor_2, target_actor_3, target_actor_b1, target_actor_b2,
        target_actor_b3, target_actor_w4, target_actor_b4, target_critic_1, target_critic_2, target_critic_3,
        target_critic_b1, target_critic_b2, target_critic_b3, target_critic_w4, target_critic_b4, critic_1, critic_2,
        critic_3, critic_3t, critic_2t, critic_b1, critic_b2, critic_b3, critic_w4, critic_b4, tiles, size, h1, h2, d1, d2,
        d3, sum1, sum2, sum3, sum4, q_out, target_out,
    )


@wp.func_native(_code("actor"))
def _actor_block(
    x: _bf16, action_l2: _f32, actor_1: _bf16, actor_2: _bf16, actor_3: _bf16, actor_3t: _bf16, actor_2t: _bf16, actor_b1:
    _f32, actor_b2: _f32, actor_b3: _f32, actor_w4: _f32, actor_b4: _f32, critic_1: _bf16, critic_2: _bf16, critic_3: _bf16,
    critic_3t: _bf16, critic_2t: _bf16, critic_b1: _f32, critic_b2: _f32, critic_b3: _f32, critic_w4: _f32, critic_b4: _f32,
    critic_action: _f32, tiles: int, size: int, h1: _bf16, h2: _bf16, h3: _bf16, d1: _bf16, d2: _bf16, d3: _bf16, sum1: _f32,
    sum2: _f32, sum3: _f32, q_out: _f32, action_out: _f32, slope_out: _f32,
): ...


@wp.kernel(module="unique", enable_backward=False, launch_bounds=(THREADS, 1), cluster_dim=BLOCKS, grid_stride=False)
def actor_pass(
    x: _bf16, action_l2: _f32, actor_1: _bf16, actor_2: _bf16, actor_3: _bf16, actor_3t: _bf16, actor_2t: _bf16, actor_b1:
    _f32, actor_b2: _f32, actor_b3: _f32, actor_w4: _f32, actor_b4: _f32, critic_1: _bf16, critic_2: _bf16, critic_3: _bf16,
    critic_3t: _bf16, critic_2t: _bf16, critic_b1: _f32, critic_b2: _f32, critic_b3: _f32, critic_w4: _f32, critic_b4: _f32,
    critic_action: _f32, tiles: int, size: int, h1: _bf16, h2: _bf16, h3: _bf16, d1: _bf16, d2: _bf16, d3: _bf16, sum1: _f32,
    sum2: _f32, sum3: _f32, q_out: _f32, action_out: _f32, slope_out: _f32,
):
    """Computes the policy's actions and their values, and the factors of the actor's gradients."""
    _ = wp.tile_empty(shape=_ACTOR_SHARED, dtype=float, storage="shared")  # reserves the block's shared memory
    _actor_block(
        x, action_l2, actor_1, actor_2, actor_3, actor_3t, actor_2t, actor_b1, actor_b2, actor_b3, actor_w4, actor_b4,
        critic_1, critic_2, critic_3, critic_3t, critic_2t, critic_b1, critic_b2, critic_b3, critic_w4, critic_b4,
        critic_action, tiles, size, h1, h2, h3, d1, d2, d3, sum1, sum2, sum3, q_out, action_out, slope_out,
    )
