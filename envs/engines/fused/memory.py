"""One environment's memory, made of one array of floats."""

from typing import Any

import mujoco
import numpy as np

from mjx_dher.envs.engines.fused.model import Floats, Layout, Memory
from mjx_dher.envs.engines.fused.near import PAIR_WORDS, SLOT_WORDS
from mjx_dher.envs.engines.fused.setup import fill, links_of
from mjx_dher.envs.engines.fused.threads import floats, ints, matrices, quats, spatials, vec3s
from mjx_dher.system.warp_setup import wp


def layout_of(model: mujoco.MjModel, world: Any, contacts: Any, dofs: Any, sparse: Any) -> Any:
    """Returns `Layout` for a model.

    `jacobian` begins with the first fields, whose place it takes; so do contacts of near pairs. `factor` begins with `pos`.
    """
    nb, nv, rows = len(links_of(model).body), model.nv, world.rows
    lengths = {
        **dict.fromkeys(("pos", "quat", "mat", "moment", "inertia", "velocity", "bias", "force"), nb),
        **dict.fromkeys(("motion", "turning", "momentum", "smooth", "qacc", "inert", "search", "step", "qvel"), nv),
        **dict.fromkeys(("mass", "factor"), nv * (nv + 1) // 2),
        "qpos": model.nq,
        **dict.fromkeys(("distance", "place", "normal"), contacts.slots),
        **dict.fromkeys(("touching", "slot"), contacts.slots),
        "limited": dofs.limits,
        "counts": 3 if contacts.elliptic else 2,
        "cone": contacts.slots if contacts.elliptic else 0,
        "jacobian": rows * nv,
        **dict.fromkeys(("weight", "residual", "change"), rows),
        **{f"sparse_{name}": sparse.rows for name in ("weight", "residual", "change", "slope")},
    }
    fields: dict[str, Any] = Memory.vars
    size_of = {name: int(np.prod(getattr(field.type.dtype, "_shape_", ()), dtype=int)) for name, field in fields.items()}
    taken = {name: lengths[name] * size_of[name] for name in fields}  # floats
    names = list(fields)
    pos, mass, factor = (names.index(name) for name in ("pos", "mass", "factor"))
    early = [] if world.equalities else ["velocity", "bias"]  # of use to equalities alone, once forces are known
    groups = [names[:pos] + early, [name for name in names[pos:mass] if name not in early], names[mass:factor]]
    begin, end = {}, 0
    least = [max(taken["jacobian"], PAIR_WORDS * contacts.near + SLOT_WORDS * contacts.near_slots), taken["factor"], 0]
    for group, at_least in zip(groups, least):
        first = end
        for name in group:
            begin[name], end = end, end + taken[name]
        if group is groups[1]:
            pair, end = end, end + (contacts.slots if contacts.near else 0)
        end = max(end, first + at_least)
    begin["jacobian"], begin["factor"] = 0, begin["pos"]
    size = 2 * ((end + 1) // 2)  # so that `jacobian` can be read in pairs
    length = [lengths[name] for name in names]
    return fill(Layout, size=size, pair=pair, begin=[begin[name] for name in names], length=length)


@wp.func
def carve(layout: Layout, spare: Floats, threads: int) -> Memory:
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
    memory.cone = ints(spare, size, begin[26], length[26], threads)
    memory.weight = floats(spare, size, begin[27], length[27], threads)
    memory.residual = floats(spare, size, begin[28], length[28], threads)
    memory.change = floats(spare, size, begin[29], length[29], threads)
    memory.sparse_weight = floats(spare, size, begin[30], length[30], threads)
    memory.sparse_residual = floats(spare, size, begin[31], length[31], threads)
    memory.sparse_change = floats(spare, size, begin[32], length[32], threads)
    memory.sparse_slope = floats(spare, size, begin[33], length[33], threads)
    memory.factor = floats(spare, size, begin[34], length[34], threads)
    memory.jacobian = floats(spare, size, begin[35], length[35], threads)
    return memory


@wp.func
def copy(source: Floats, target: Floats, thread: int, threads: int):
    """Copies one array into another of the same length."""
    for i in range(thread, target.shape[0], threads):
        target[i] = source[i]
