"""One environment's memory, made of one array of floats."""

from mjx_dher.envs.engines.fused.model import Layout, Memory
from mjx_dher.envs.engines.fused.threads import floats, ints, matrices, quats, spatials, vec3s
from mjx_dher.system.warp_setup import wp


@wp.func
def carve(layout: Layout, spare: wp.array(dtype=float), threads: int) -> Memory:
    """Returns the fields of an environment's memory, in the places that `layout` gives them.

    Args:
      spare: [size] memory to use on a CPU.
    """
    memory = Memory()
    begin = layout.begin
    length = layout.length
    size = layout.size
    memory.moment = vec3s(spare, size, begin[0], length[0], threads)
    memory.inertia = matrices(spare, size, begin[1], length[1], threads)
    memory.force = spatials(spare, size, begin[2], length[2], threads)
    memory.turning = spatials(spare, size, begin[3], length[3], threads)
    memory.momentum = spatials(spare, size, begin[4], length[4], threads)
    memory.pos = vec3s(spare, size, begin[5], length[5], threads)
    memory.quat = quats(spare, size, begin[6], length[6], threads)
    memory.mat = matrices(spare, size, begin[7], length[7], threads)
    memory.velocity = spatials(spare, size, begin[8], length[8], threads)
    memory.bias = spatials(spare, size, begin[9], length[9], threads)
    memory.motion = spatials(spare, size, begin[10], length[10], threads)
    memory.distance = floats(spare, size, begin[11], length[11], threads)
    memory.place = vec3s(spare, size, begin[12], length[12], threads)
    memory.normal = vec3s(spare, size, begin[13], length[13], threads)
    memory.touching = ints(spare, size, begin[14], length[14], threads)
    memory.slot = ints(spare, size, begin[15], length[15], threads)
    memory.limited = ints(spare, size, begin[16], length[16], threads)
    memory.mass = floats(spare, size, begin[17], length[17], threads)
    memory.smooth = floats(spare, size, begin[18], length[18], threads)
    memory.qacc = floats(spare, size, begin[19], length[19], threads)
    memory.inert = floats(spare, size, begin[20], length[20], threads)
    memory.search = floats(spare, size, begin[21], length[21], threads)
    memory.step = floats(spare, size, begin[22], length[22], threads)
    memory.qpos = floats(spare, size, begin[23], length[23], threads)
    memory.qvel = floats(spare, size, begin[24], length[24], threads)
    memory.counts = ints(spare, size, begin[25], length[25], threads)
    memory.weight = floats(spare, size, begin[26], length[26], threads)
    memory.residual = floats(spare, size, begin[27], length[27], threads)
    memory.change = floats(spare, size, begin[28], length[28], threads)
    memory.sparse_weight = floats(spare, size, begin[29], length[29], threads)
    memory.sparse_residual = floats(spare, size, begin[30], length[30], threads)
    memory.sparse_change = floats(spare, size, begin[31], length[31], threads)
    memory.sparse_slope = floats(spare, size, begin[32], length[32], threads)
    memory.factor = floats(spare, size, begin[33], length[33], threads)
    memory.jacobian = floats(spare, size, begin[34], length[34], threads)
    return memory


@wp.func
def copy(source: wp.array(dtype=float), target: wp.array(dtype=float), thread: int, threads: int):
    """Copies one array into another of the same length."""
    for i in range(thread, target.shape[0], threads):
        target[i] = source[i]
