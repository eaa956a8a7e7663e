"""One environment's memory, made of one array of floats."""

from mjx_dher.envs.engines.fused.model import Layout, Memory
from mjx_dher.envs.engines.fused.threads import floats, ints, matrices, quats, spatials, vec3s
from mjx_dher.system.warp_setup import wp


@wp.func
def carve(layout: Layout, spare: wp.array(dtype=float), lanes: int) -> Memory:
    """Returns the fields of an environment's memory, in the places that `layout` gives them.

    Args:
      spare: [size] memory to use on a CPU.
    """
    memory = Memory()
    begin = layout.begin
    length = layout.length
    size = layout.size
    memory.moment = vec3s(spare, size, begin[0], length[0], lanes)
    memory.inertia = matrices(spare, size, begin[1], length[1], lanes)
    memory.force = spatials(spare, size, begin[2], length[2], lanes)
    memory.turning = spatials(spare, size, begin[3], length[3], lanes)
    memory.momentum = spatials(spare, size, begin[4], length[4], lanes)
    memory.pos = vec3s(spare, size, begin[5], length[5], lanes)
    memory.quat = quats(spare, size, begin[6], length[6], lanes)
    memory.mat = matrices(spare, size, begin[7], length[7], lanes)
    memory.velocity = spatials(spare, size, begin[8], length[8], lanes)
    memory.bias = spatials(spare, size, begin[9], length[9], lanes)
    memory.motion = spatials(spare, size, begin[10], length[10], lanes)
    memory.mass = floats(spare, size, begin[11], length[11], lanes)
    memory.smooth = floats(spare, size, begin[12], length[12], lanes)
    memory.qacc = floats(spare, size, begin[13], length[13], lanes)
    memory.inert = floats(spare, size, begin[14], length[14], lanes)
    memory.search = floats(spare, size, begin[15], length[15], lanes)
    memory.step = floats(spare, size, begin[16], length[16], lanes)
    memory.factor = floats(spare, size, begin[17], length[17], lanes)
    memory.qpos = floats(spare, size, begin[18], length[18], lanes)
    memory.qvel = floats(spare, size, begin[19], length[19], lanes)
    memory.distance = floats(spare, size, begin[20], length[20], lanes)
    memory.place = vec3s(spare, size, begin[21], length[21], lanes)
    memory.normal = vec3s(spare, size, begin[22], length[22], lanes)
    memory.touching = ints(spare, size, begin[23], length[23], lanes)
    memory.slot = ints(spare, size, begin[24], length[24], lanes)
    memory.limited = ints(spare, size, begin[25], length[25], lanes)
    memory.counts = ints(spare, size, begin[26], length[26], lanes)
    memory.weight = floats(spare, size, begin[27], length[27], lanes)
    memory.residual = floats(spare, size, begin[28], length[28], lanes)
    memory.change = floats(spare, size, begin[29], length[29], lanes)
    memory.jacobian = floats(spare, size, begin[30], length[30], lanes)
    return memory


@wp.func
def copy(source: wp.array(dtype=float), target: wp.array(dtype=float), lane: int, lanes: int):
    """Copies one array into another of the same length."""
    for i in range(lane, target.shape[0], lanes):
        target[i] = source[i]
