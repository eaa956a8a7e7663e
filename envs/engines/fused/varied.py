# mypy: disable-error-code="valid-type, empty-body"
"""Numbers of a model that each environment has for itself, behind its inputs. Other kernels have none of this code."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.engines.fused import setup
from mjx_dher.envs.engines.fused.model import Bodies, Contacts, Dofs, Floats
from mjx_dher.envs.engines.pairs import LEAST_FRICTION, all_pairs, frictions, meeting, mixed_friction
from mjx_dher.envs.engines.variation import Variation
from mjx_dher.system.warp_setup import wp
from mjx_dher.types import Array

Begins = tuple[int, int, int, int]  # in an environment's inputs, of the numbers of each kind; -1 if a kind does not vary
NONE: Begins = (-1, -1, -1, -1)


class Numbers:
    """The kernel's numbers, by kind: mass, damping, gain, friction.

    Args:
      first: number of inputs before them.
    """

    def __init__(self, model: mujoco.MjModel, variation: Variation, first: int):
        self._model = model
        self._links, self._pairs, self._met = setup.links_of(model), all_pairs(model), meeting(model)
        fields = [("body_mass",), ("dof_damping",), ("actuator_gainprm",), ("geom_friction", "pair_friction")]
        self._varies = [any(field in variation.fields for field in of_kind) for of_kind in fields]
        begins, ends = [], first
        for varies, arrays in zip(self._varies, self._arrays({}, np)):
            begins.append(ends if varies else -1)
            ends += sum(array.size for array in arrays) if varies else 0
        self.begins: Begins = tuple(begins)  # type: ignore[assignment]

    def row(self, values: dict[str, Any]) -> list[Array]:
        """Arrays [...] that follow an environment's inputs, given JAX values of the fields that vary."""
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            kinds = zip(self._varies, self._arrays(values, jnp))
            return [jnp.ravel(array).astype(jnp.float32) for varies, arrays in kinds if varies for array in arrays]

    def _arrays(self, values: dict[str, Any], xp: Any) -> list[list[Any]]:
        """Arrays of the structs' fields in the order in which `vary` takes them, given the fields that differ."""
        model = self._model

        def of(field: str) -> Any:
            return values.get(field, getattr(model, field))

        links, pairs, met = self._links, self._pairs, self._met
        ends = links.last[links.body] == np.arange(len(links.body))
        damping = of("dof_damping")
        named = xp.maximum(of("pair_friction")[: len(pairs.dim) - len(met)], LEAST_FRICTION)
        friction = xp.concatenate([named, mixed_friction(model, met, of("geom_friction"), xp)])
        return [
            [of("body_mass")[links.body] * ends, of("body_inertia")[links.body] * ends[:, None]],
            [damping, damping * setup.damps_implicitly(model)],
            [setup.actuator_force(model, of("actuator_gainprm"), of("actuator_biasprm"), xp)],
            [*frictions(model, pairs, friction, xp).values()],
        ]


def _row(of: str) -> str:
    """Returns code that makes an array of a part of an environment's inputs."""
    return f"return wp::array_t<{of}>(reinterpret_cast<{of}*>(row.data + begin), length);"


@wp.func_native(_row("wp::float32"))
def _floats(row: Floats, begin: int, length: int) -> wp.array(dtype=float): ...


@wp.func_native(_row("wp::vec_t<2, wp::float32>"))
def _vec2s(row: Floats, begin: int, length: int) -> wp.array(dtype=wp.vec2): ...


@wp.func_native(_row("wp::vec_t<3, wp::float32>"))
def _vec3s(row: Floats, begin: int, length: int) -> wp.array(dtype=wp.vec3): ...


@wp.func_native(_row("wp::vec_t<4, wp::float32>"))
def _vec4s(row: Floats, begin: int, length: int) -> wp.array(dtype=wp.vec4): ...


def owning(begins: Begins) -> tuple[Any, Any, Any]:
    """Returns functions (struct, inputs of an environment) -> struct, for `Bodies`, `Dofs` and `Contacts` with its numbers."""
    mass, damping, gain, friction = begins

    @wp.func
    def bodies_of(bodies: Bodies, row: Floats) -> Bodies:
        if wp.static(mass >= 0):
            number = bodies.number
            bodies.mass = _floats(row, wp.static(mass), number)
            bodies.inertia = _vec3s(row, wp.static(mass) + number, number)
        return bodies

    @wp.func
    def dofs_of(dofs: Dofs, row: Floats) -> Dofs:
        if wp.static(damping >= 0):
            nv = dofs.number
            dofs.damping = _floats(row, wp.static(damping), nv)
            dofs.implicit_damping = _floats(row, wp.static(damping) + nv, nv)
        if wp.static(gain >= 0):
            dofs.actuator_force = _vec4s(row, wp.static(gain), dofs.actuators)
        return dofs

    @wp.func
    def contacts_of(contacts: Contacts, row: Floats) -> Contacts:
        if wp.static(friction >= 0):
            pairs = contacts.pairs
            contacts.friction = _vec3s(row, wp.static(friction), pairs)
            contacts.rolling = _vec2s(row, wp.static(friction) + 3 * pairs, pairs)
            contacts.weight = _floats(row, wp.static(friction) + 5 * pairs, pairs)
            contacts.mu = _floats(row, wp.static(friction) + 6 * pairs, pairs)
        return contacts

    return bodies_of, dofs_of, contacts_of
