"""Constraint rows with few coefficients: friction of joints and tendons, joint and tendon equalities, and limits.

A row has the same place whether it acts or not, and its coefficients are the model's. So it takes four numbers of an
environment's memory, where a row of `constraints` takes one for each degree of freedom.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_dher.envs.engines.fused.constraints import asked
from mjx_dher.envs.engines.fused.model import Floats, Memory, Sparse
from mjx_dher.envs.engines.fused.setup import JOINT, TENDON, fill, is_sparse, softness
from mjx_dher.envs.engines.fused.threads import sync
from mjx_dher.system.warp_setup import wp


class _Row(NamedTuple):
    """A row: an entry of `Sparse` in each of its fields."""

    terms: list[tuple[int, float, int]]  # degree of freedom, coefficient, and whether the row's slope multiplies it
    rest: bool  # whether coordinates count from `qpos0`
    soft: Any
    inverse: float
    loss: float = 0.0
    span: tuple[float, float] = (0.0, 0.0)
    margin: float = 0.0
    poly: tuple[float, ...] = (0.0,) * 5


def sparse_of(model: mujoco.MjModel) -> Any:
    """Returns `Sparse` of a model: without rows if the model has no friction, no tendon, and no equality of joints."""
    friction, equal, limits = (list(rows(model)) if is_sparse(model) else [] for rows in (_frictions, _equalities, _limits))
    rows = [*friction, *equal, *limits]
    terms = [(row, *term) for row, each in enumerate(rows) for term in each.terms]
    dof = np.array([term[1] for term in terms], int)
    qpos = model.jnt_qposadr[model.dof_jntid[dof]]
    row = np.array([term[0] for term in terms], int)
    by_dof = np.argsort(dof, kind="stable")
    rests = np.array([each.rest for each in rows], bool)
    return fill(
        Sparse,
        rows=len(rows),
        frictions=len(friction),
        limits=len(friction) + len(equal),
        begin=np.searchsorted(row, np.arange(len(rows) + 1)),
        dof=dof,
        qpos=qpos,
        coef=[term[2] for term in terms],
        sloped=[term[3] for term in terms],
        rest=np.where(rests[row], model.qpos0[qpos], 0.0),
        row=row,
        dof_begin=np.searchsorted(dof[by_dof], np.arange(model.nv + 1)),
        dof_term=by_dof,
        **{name: [getattr(each, name) for each in rows] for name in ("soft", "inverse", "loss", "span", "margin", "poly")},
    )


def _tendon(model: mujoco.MjModel, tendon: int, sloped: int) -> list[tuple[int, float, int]]:
    """Terms of a fixed tendon's length."""
    wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    return [(int(model.jnt_dofadr[model.wrap_objid[wrap]]), float(model.wrap_prm[wrap]), sloped) for wrap in wraps]


def _frictions(model: mujoco.MjModel) -> Any:
    for dof in np.flatnonzero(model.dof_frictionloss > 0):
        soft = softness(model, model.dof_solref[dof], model.dof_solimp[dof])
        yield _Row([(int(dof), 1.0, 0)], False, soft, model.dof_invweight0[dof], model.dof_frictionloss[dof])
    for tendon in np.flatnonzero(model.tendon_frictionloss > 0):
        soft = softness(model, model.tendon_solref_fri[tendon], model.tendon_solimp_fri[tendon])
        loss = model.tendon_frictionloss[tendon]
        yield _Row(_tendon(model, tendon, 0), False, soft, model.tendon_invweight0[tendon], loss)


def _equalities(model: mujoco.MjModel) -> Any:
    for eq in range(model.neq):
        objects = [int(each) for each in (model.eq_obj1id[eq], model.eq_obj2id[eq]) if each >= 0]
        if model.eq_type[eq] == JOINT:
            dofs = model.jnt_dofadr[objects]
            parts = [[(int(dof), 1.0, number)] for number, dof in enumerate(dofs)]
            inverse = model.dof_invweight0[dofs].sum()
        elif model.eq_type[eq] == TENDON:
            parts = [_tendon(model, tendon, number) for number, tendon in enumerate(objects)]
            inverse = model.tendon_invweight0[objects].sum()
        else:
            continue
        soft = softness(model, model.eq_solref[eq], model.eq_solimp[eq])
        yield _Row([term for part in parts for term in part], True, soft, inverse, poly=tuple(model.eq_data[eq, :5]))


def _limits(model: mujoco.MjModel) -> Any:
    for joint in np.flatnonzero(model.jnt_limited):
        soft = softness(model, model.jnt_solref[joint], model.jnt_solimp[joint])
        dof, span = int(model.jnt_dofadr[joint]), tuple(model.jnt_range[joint])
        yield _Row([(dof, 1.0, 1)], False, soft, model.dof_invweight0[dof], 0.0, span, model.jnt_margin[joint])
    for tendon in np.flatnonzero(model.tendon_limited):
        soft = softness(model, model.tendon_solref_lim[tendon], model.tendon_solimp_lim[tendon])
        inverse, span = model.tendon_invweight0[tendon], tuple(model.tendon_range[tendon])
        yield _Row(_tendon(model, tendon, 1), False, soft, inverse, 0.0, span, model.tendon_margin[tendon])


@wp.func
def _coefficient(sparse: Sparse, memory: Memory, term: int, row: int) -> float:
    return sparse.coef[term] * wp.where(sparse.sloped[term] == 1, memory.sparse_slope[row], 1.0)


@wp.func
def ask_sparse(sparse: Sparse, memory: Memory, thread: int, threads: int):
    """Sets slopes, weights and reference accelerations of the rows."""
    for row in range(thread, sparse.rows, threads):
        length, other, velocity, other_velocity = float(0.0), float(0.0), float(0.0), float(0.0)
        for term in range(sparse.begin[row], sparse.begin[row + 1]):
            at = sparse.coef[term] * (memory.qpos[sparse.qpos[term]] - sparse.rest[term])
            speed = sparse.coef[term] * memory.qvel[sparse.dof[term]]
            if sparse.sloped[term] == 1:
                other += at
                other_velocity += speed
            else:
                length += at
                velocity += speed
        slope, depth = float(1.0), float(0.0)
        if row >= sparse.limits:
            span = sparse.span[row]
            slope = wp.where(other - span[0] < span[1] - other, 1.0, -1.0)
            depth = wp.min(other - span[0], span[1] - other) - sparse.margin[row]
        elif row >= sparse.frictions:
            p = sparse.poly[row]
            slope = -(p[1] + other * (2.0 * p[2] + other * (3.0 * p[3] + other * 4.0 * p[4])))
            depth = length - (p[0] + other * (p[1] + other * (p[2] + other * (p[3] + other * p[4]))))
        asks = asked(sparse.soft[row], depth, depth, sparse.inverse[row], velocity + slope * other_velocity)
        memory.sparse_slope[row] = slope
        memory.sparse_weight[row] = wp.where(row < sparse.limits or depth < 0.0, asks[0], 0.0)
        memory.sparse_residual[row] = asks[1]
    sync(threads)


@wp.func
def _pull(sparse: Sparse, memory: Memory, row: int, residual: float) -> wp.vec2:
    """First and second derivative of a row's cost: friction's is linear from its greatest force on."""
    weight = memory.sparse_weight[row]
    if row < sparse.frictions:
        if wp.abs(weight * residual) > sparse.loss[row]:
            return wp.vec2(wp.sign(residual) * sparse.loss[row], 0.0)
    elif row >= sparse.limits and residual >= 0.0:
        return wp.vec2(0.0, 0.0)
    return wp.vec2(weight * residual, weight)


@wp.func
def _times(sparse: Sparse, memory: Memory, row: int, x: Floats) -> float:
    """A row's coefficients times a vector [nv]."""
    sum = float(0.0)
    for term in range(sparse.begin[row], sparse.begin[row + 1]):
        sum += _coefficient(sparse, memory, term, row) * x[sparse.dof[term]]
    return sum


@wp.func
def begin_sparse(sparse: Sparse, memory: Memory, thread: int, threads: int) -> float:
    """Computes the residuals of the first guess. Returns a thread's part of their uncertain energy."""
    unsure = float(0.0)
    for row in range(thread, sparse.rows, threads):
        asks = memory.sparse_residual[row]
        has = _times(sparse, memory, row, memory.qacc)
        memory.sparse_residual[row] = has - asks
        size = wp.abs(has) + wp.abs(asks)
        unsure += _pull(sparse, memory, row, has - asks)[1] * size * size
    return unsure


@wp.func
def change_sparse(sparse: Sparse, memory: Memory, thread: int, threads: int):
    """Computes how residuals change along the search direction."""
    for row in range(thread, sparse.rows, threads):
        memory.sparse_change[row] = _times(sparse, memory, row, memory.search)


@wp.func
def slopes_sparse(sparse: Sparse, memory: Memory, at: float, thread: int, threads: int) -> wp.vec2:
    """A thread's part of the cost's derivatives at a step along the search direction."""
    d1, d2 = float(0.0), float(0.0)
    for row in range(thread, sparse.rows, threads):
        change = memory.sparse_change[row]
        pull = _pull(sparse, memory, row, memory.sparse_residual[row] + at * change)
        d1 += pull[0] * change
        d2 += pull[1] * change * change
    return wp.vec2(d1, d2)


@wp.func
def take_sparse(sparse: Sparse, memory: Memory, far: float, thread: int, threads: int) -> float:
    """Takes a step along the search direction. Returns a thread's number of rows whose cost is of another piece now."""
    changed = float(0.0)
    for row in range(thread, sparse.rows, threads):
        before = memory.sparse_residual[row]
        after = before + far * memory.sparse_change[row]
        memory.sparse_residual[row] = after
        was, now = _pull(sparse, memory, row, before), _pull(sparse, memory, row, after)
        if was[1] != now[1] or (row < sparse.frictions and now[1] == 0.0 and before * after < 0.0):
            changed += 1.0
    return changed


@wp.func
def add_sparse(sparse: Sparse, memory: Memory, nv: int, stiff: int, thread: int, threads: int):
    """Adds the rows' forces to `search`; and with `stiff` 1 puts the mass matrix and their stiffness into `factor`."""
    if stiff == 1:
        for at in range(thread, memory.mass.shape[0], threads):
            memory.factor[at] = memory.mass[at]
        sync(threads)
    for i in range(thread, nv, threads):
        for at in range(sparse.dof_begin[i], sparse.dof_begin[i + 1]):
            row = sparse.row[sparse.dof_term[at]]
            if memory.sparse_weight[row] > 0.0:
                coef = _coefficient(sparse, memory, sparse.dof_term[at], row)
                pull = _pull(sparse, memory, row, memory.sparse_residual[row])
                memory.search[i] = memory.search[i] - coef * pull[0]
                if stiff == 1 and pull[1] > 0.0:
                    for term in range(sparse.begin[row], sparse.begin[row + 1]):
                        if sparse.dof[term] <= i:
                            place = i * (i + 1) // 2 + sparse.dof[term]
                            more = coef * pull[1] * _coefficient(sparse, memory, term, row)
                            memory.factor[place] = memory.factor[place] + more
    sync(threads)
