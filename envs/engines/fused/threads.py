# mypy: disable-error-code="empty-body"
"""The GPU threads, neighbours in one warp, that share the work on one environment.

`threads` is their number, a power of 2 up to 32, and 1 on a CPU. `thread` is the index of one. Each part of a substep is a
loop that begins at `thread` and advances by `threads`.
"""

from mjx_dher.envs.engines.fused.model import Ints, Memory
from mjx_dher.system.warp_setup import wp

_GROUP = "const unsigned group = threads == 32 ? ~0u : ((1u << threads) - 1u) << (threadIdx.x & 31 & ~(threads - 1));"
_SUM = f"""
#if defined(__CUDA_ARCH__)
    {_GROUP}
    for (int other = threads / 2; other > 0; other /= 2) x += __shfl_xor_sync(group, x, other);
#endif
    return x;
"""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_GROUP}
    __syncwarp(group);
#endif
""")
def sync(threads: int):  # type: ignore[no-untyped-def]
    """Waits for the environment's other threads; their writes are visible afterwards."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (warps > 1) __syncthreads();
#endif
""")
def gather(warps: int):  # type: ignore[no-untyped-def]
    """Waits for the other warps of the block.

    It is not needed for correctness. But the kernel's instructions do not fit into the instruction cache, and the warps of a
    multiprocessor get them two to four times as fast if all need the same ones at the same time.
    """


@wp.func_native(_SUM)
def total(x: float, threads: int) -> float:
    """Sum of the threads' numbers, with the same bits in each thread."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_GROUP}
    int sum = x;
    for (int other = 1; other < threads; other *= 2) {{
        const int more = __shfl_up_sync(group, sum, other, threads);
        if (thread >= other) sum += more;
    }}
    return sum - x;
#else
    return 0;
#endif
""")
def earlier(x: int, thread: int, threads: int) -> int:
    """Sum of the numbers of the threads before this one."""


@wp.func_native(_SUM)
def all_of(x: int, threads: int) -> int:
    """Sum of the threads' numbers."""


def _carve(of: str) -> str:
    """Returns code that makes an array of a field of one environment's memory: on a GPU in the block's shared memory."""
    return f"""
#if defined(__CUDA_ARCH__)
    extern __shared__ char dynamic_smem_base[];
    float* const all = reinterpret_cast<float*>(dynamic_smem_base) + threadIdx.x / threads * size;
#else
    float* const all = spare.data;
#endif
    return wp::array_t<{of}>(reinterpret_cast<{of}*>(all + begin), length);
"""


@wp.func_native(_carve("wp::int32"))
def ints(spare: wp.array(dtype=float), size: int, begin: int, length: int, threads: int) -> wp.array(dtype=int):
    """Returns `length` values that begin at a place in the environment's memory."""


@wp.func_native(_carve("wp::float32"))
def floats(spare: wp.array(dtype=float), size: int, begin: int, length: int, threads: int) -> wp.array(dtype=float):
    """Returns `length` values that begin at a place in the environment's memory."""


@wp.func_native(_carve("wp::vec_t<3, wp::float32>"))
def vec3s(spare: wp.array(dtype=float), size: int, begin: int, length: int, threads: int) -> wp.array(dtype=wp.vec3):
    """Returns `length` values that begin at a place in the environment's memory."""


@wp.func_native(_carve("wp::vec_t<4, wp::float32>"))
def quats(spare: wp.array(dtype=float), size: int, begin: int, length: int, threads: int) -> wp.array(dtype=wp.vec4):
    """Returns `length` values that begin at a place in the environment's memory."""


@wp.func_native(_carve("wp::mat_t<3, 3, wp::float32>"))
def matrices(spare: wp.array(dtype=float), size: int, begin: int, length: int, threads: int) -> wp.array(dtype=wp.mat33):
    """Returns `length` values that begin at a place in the environment's memory."""


@wp.func_native(_carve("wp::vec_t<6, wp::float32>"))
def spatials(spare: wp.array(dtype=float), size: int, begin: int, length: int, threads: int) -> wp.array(
    dtype=wp.spatial_vector
):
    """Returns `length` values that begin at a place in the environment's memory."""


@wp.func
def give_up(memory: Memory, lost: Ints):
    """Counts a contact that there is no room for. A NaN tells `kernel._end` that the state is wrong."""
    wp.atomic_add(lost, 0, 1)
    memory.qvel[0] = wp.nan
