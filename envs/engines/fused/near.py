"""Pairs of geoms that are near one another, for models with many pairs.

Most pairs of a hand are far apart in any one state. Memory for the contacts of all pairs at once would leave less for other
environments. So each substep lists the pairs whose bounding boxes meet, finds their contacts in memory that is later used for
the rows of constraints, and keeps those that touch. All lists are in the order of the pairs for any schedule of the threads.
"""

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.contacts import geom_of
from mjx_dher.envs.engines.fused.model import Contacts, Floats, Ints, Layout, Memory
from mjx_dher.envs.engines.fused.threads import all_of, earlier, floats, give_up, ints, sync, vec3s
from mjx_dher.system.warp_setup import wp

PAIR_WORDS, SLOT_WORDS = 7, 7  # memory of a pair, and of a slot, in floats
_PLANES = (kinds.PLANE_BOX, kinds.PLANE_CYLINDER, kinds.PLANE_SPHERE, kinds.PLANE_CAPSULE, kinds.PLANE_ELLIPSOID)
_OF_PLANES = wp.constant(sum(1 << kind for kind in _PLANES))  # mask of kinds
_SLOTS = wp.constant(1 << 16)  # one pair, in a number that also counts its slots


@wp.func
def near_pairs(
    contacts: Contacts, memory: Memory, layout: Layout, spare: Floats, lost: Ints, thread: int, threads: int
) -> Contacts:
    """Returns the pairs whose bounding boxes meet, with slots for their contacts.

    Pairs that there is no room for are counted in `lost`.
    """
    near = contacts
    size, most = layout.size, contacts.near
    near.geom1 = ints(spare, size, 0, most, threads)
    near.geom2 = ints(spare, size, most, most, threads)
    near.kind = ints(spare, size, 2 * most, most, threads)
    near.first = ints(spare, size, 3 * most, most, threads)
    near.most = ints(spare, size, 4 * most, most, threads)
    near.pair = ints(spare, size, 5 * most, most, threads)
    near.margin = floats(spare, size, 6 * most, most, threads)
    number = int(0)
    slots = int(0)
    sync(threads)
    for begin in range(0, contacts.pairs, threads):
        p = begin + thread
        count = int(0)
        if p < contacts.pairs:
            if _meet(contacts, memory, p):
                count = _SLOTS + contacts.most[p]
        before = earlier(count, thread, threads)
        if count > 0:
            at = number + before // _SLOTS
            first = slots + before % _SLOTS
            if at < most and first + contacts.most[p] <= contacts.near_slots:
                near.geom1[at] = contacts.geom1[p]
                near.geom2[at] = contacts.geom2[p]
                near.kind[at] = contacts.kind[p]
                near.first[at] = first
                near.most[at] = contacts.most[p]
                near.pair[at] = p
                near.margin[at] = contacts.margin[p]
            else:
                give_up(memory, lost)
                if at < most:
                    near.most[at] = 0
                    near.kind[at] = -1
        everyone = all_of(count, threads)
        number += everyone // _SLOTS
        slots += everyone % _SLOTS
    near.pairs = wp.min(number, most)
    sync(threads)
    return near


@wp.func
def memory_of(contacts: Contacts, memory: Memory, layout: Layout, spare: Floats, threads: int) -> Memory:
    """Returns the memory in which contacts of the pairs that are near are found."""
    scratch = memory
    begin, slots = wp.static(PAIR_WORDS) * contacts.near, contacts.near_slots
    scratch.distance = floats(spare, layout.size, begin, slots, threads)
    scratch.place = vec3s(spare, layout.size, begin + slots, slots, threads)
    scratch.normal = vec3s(spare, layout.size, begin + 4 * slots, slots, threads)
    return scratch


@wp.func
def keep(
    contacts: Contacts,
    near: Contacts,
    scratch: Memory,
    memory: Memory,
    layout: Layout,
    spare: Floats,
    lost: Ints,
    thread: int,
    threads: int,
) -> Contacts:
    """Moves contacts within their margin to the places that stay, and returns their pairs as `Contacts.pair`.

    Contacts that there is no room for are counted in `lost`.
    """
    held = contacts
    held.pair = ints(spare, layout.size, layout.pair, contacts.slots, threads)
    kept = int(0)
    for begin in range(0, near.pairs, threads):
        i = begin + thread
        number = int(0)
        if i < near.pairs:
            for s in range(near.first[i], near.first[i] + near.most[i]):
                if scratch.distance[s] < near.margin[i]:
                    number += 1
        at = kept + earlier(number, thread, threads)
        if number > 0:
            for s in range(near.first[i], near.first[i] + near.most[i]):
                if scratch.distance[s] < near.margin[i]:
                    if at < contacts.slots:
                        memory.distance[at] = scratch.distance[s]
                        memory.place[at] = scratch.place[s]
                        memory.normal[at] = scratch.normal[s]
                        held.pair[at] = near.pair[i]
                    else:
                        give_up(memory, lost)
                    at += 1
        kept += all_of(number, threads)
    held.slots = wp.min(kept, contacts.slots)
    sync(threads)
    return held


@wp.func
def _meet(contacts: Contacts, memory: Memory, p: int) -> bool:
    """Whether the bounding boxes of two geoms come closer than the margin, as far as the axes of both boxes tell."""
    geom1, geom2 = contacts.geom1[p], contacts.geom2[p]
    pos1, mat1, _size1 = geom_of(contacts, memory, geom1)
    pos2, mat2, _size2 = geom_of(contacts, memory, geom2)
    between = pos2 - pos1
    half2 = contacts.geom_half[geom2]
    margin = contacts.margin[p]
    axes = wp.transpose(mat1) * mat2
    at1 = wp.transpose(mat1) * between
    if (_OF_PLANES >> contacts.kind[p]) & 1 == 1:
        return at1[2] <= wp.abs(axes[2, 0]) * half2[0] + wp.abs(axes[2, 1]) * half2[1] + wp.abs(axes[2, 2]) * half2[2] + margin
    if not (wp.length(between) <= contacts.geom_reach[geom1] + contacts.geom_reach[geom2] + margin):  # also if it is NaN
        return False
    half1 = contacts.geom_half[geom1]
    at2 = wp.transpose(mat2) * between
    for i in range(3):
        along1, along2 = half1[i] + margin, half2[i] + margin
        for j in range(3):
            along1 += wp.abs(axes[i, j]) * half2[j]
            along2 += wp.abs(axes[j, i]) * half1[j]
        if wp.abs(at1[i]) > along1 or wp.abs(at2[i]) > along2:
            return False
    return True
