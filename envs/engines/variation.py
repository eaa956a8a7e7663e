"""Physics that differs between simulations of one model: factors of masses, friction, damping and gains."""

import copy
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.engines.features import check_inputs
from mjx_dher.envs.engines.pairs import too_slippery
from mjx_dher.envs.kinematics import names_of, pick
from mjx_dher.lookup import check_name
from mjx_dher.types import Array, PRNGKey
from mjx_dher.validation import check_number

# Fields of MjModel by kind of factor.
_FIELDS = {
    "mass": ("body_mass", "body_inertia"),
    "friction": ("geom_friction", "pair_friction"),
    "damping": ("dof_damping",),
    "gain": ("actuator_gainprm", "actuator_biasprm"),
}
_OBJECTS = {"mass": "body", "friction": "geom", "damping": "joint", "gain": "actuator"}
_LINEAR = {
    "gaintype": (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)),
    "biastype": (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)),
}


class Variation:
    """Numbers of a model that vary, each multiplied by one of `size` factors.

    Numbers that MuJoCo derives from masses for the softness of constraints (`invweight0`) keep the model's values.

    Args:
      names: "KIND:NAMES" for each factor. "mass" is of bodies and includes the inertia. "friction" is of geoms, and of contact
        pairs with one of these geoms. "damping" is of joints. "gain" is of actuators and multiplies the force. Several names
        are separated by spaces and can have "*" and "?".

    Raises:
      ValueError: the model lacks a name, a factor would change nothing, or two factors would change the same number.
    """

    def __init__(self, model: mujoco.MjModel, names: Sequence[str]):
        if isinstance(names, str) or not (isinstance(names, Sequence) and all(isinstance(name, str) for name in names)):
            raise ValueError(f'varied must be a list of names such as "mass:box"; got {names!r}')
        self.names, self.size = tuple(names), len(names)
        numbers: dict[str, np.ndarray] = {}  # of the factor of each object, `size` if there is none
        for number, name in enumerate(self.names):
            kind, _, patterns = name.partition(":")
            check_name("kind of varied physics", kind, _OBJECTS)
            if kind == "gain":
                check_inputs(model)
            chosen = _choose(model, name, kind, patterns)
            of_kind = numbers.setdefault(kind, np.full(len(names_of(model, _OBJECTS[kind])), self.size))
            if twice := [names_of(model, _OBJECTS[kind])[i] for i in chosen if of_kind[i] < self.size]:
                raise ValueError(f"varied: two factors change the {kind} of {', '.join(twice)}")
            of_kind[chosen] = number
        # Field -> its numbers [n, ...], and the factors [n, 2] of which the larger multiplies them.
        self._fields: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for kind, of_kind in numbers.items():
            for field in _FIELDS[kind]:
                which = _of_field(model, field, of_kind, self.size)
                if (which < self.size).any():
                    self._fields[field] = np.array(getattr(model, field)), which
        # Field -> its numbers [n], and their change per unit of each factor [size, n].
        self._sums = {}
        if "body_mass" in self._fields:
            slopes = [_constants(self.changed(model, row)) for row in np.eye(self.size)]
            for field, nominal in _constants(self.changed(model, np.zeros(self.size))).items():
                self._sums[field] = nominal, np.stack([each[field] - nominal for each in slopes])

    def changed(self, model: mujoco.MjModel, more: np.ndarray) -> mujoco.MjModel:
        """A model whose numbers are multiplied by the factors 1 + `more` [size]."""
        changed = copy.copy(model)
        for field, value in self.values(1 + more).items():
            getattr(changed, field)[...] = value
        return changed

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields of MjModel that vary."""
        return *self._fields, *self._sums

    def values(self, factors: Any, xp: Any = np) -> dict[str, Any]:
        """Values [..., n, ...] of the fields, for factors [..., size], computed by `xp`: NumPy or jax.numpy."""
        more, values = factors - 1, {}
        factors = xp.concatenate([factors, xp.ones_like(factors[..., :1])], axis=-1)
        for field, (nominal, which) in self._fields.items():
            factor = xp.max(factors[..., which], axis=-1)
            values[field] = factor.reshape(factor.shape + (1,) * (nominal.ndim - 1)) * xp.asarray(nominal, factors.dtype)
        for field, (nominal, slopes) in self._sums.items():
            values[field] = xp.asarray(nominal, factors.dtype) + more @ xp.asarray(slopes, factors.dtype)
        return values

    def factors(self, given: Any, xp: Any) -> Any:
        """The factors [size] of a state: 1 if it has none."""
        return xp.ones(self.size, np.float32) if given is None else given


def _constants(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Numbers that MuJoCo derives from masses, and that are sums over bodies."""
    model = copy.copy(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return {name: np.array(getattr(model, name)) for name in ("body_subtreemass", "dof_M0")}


def _choose(model: mujoco.MjModel, name: str, kind: str, patterns: str) -> list[int]:
    """Indices of the objects that a factor changes."""
    columns = [names_of(model, _OBJECTS[kind])]
    if kind == "gain":  # an actuator may be named by its joint
        driven = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
        joints = zip(model.actuator_trntype.tolist(), model.actuator_trnid[:, 0].tolist())
        columns.append([names_of(model, "joint")[joint] if trn in driven else "" for trn, joint in joints])
    chosen = pick(f"{_OBJECTS[kind]} of varied {name!r}", patterns, *columns)
    if kind == "gain":
        for field, kinds in _LINEAR.items():
            if odd := [columns[0][i] for i in chosen if getattr(model, f"actuator_{field}")[i] not in kinds]:
                raise ValueError(f"varied: {name!r} changes motors and servos; {odd[0]!r} has another {field}")
    numbers = [np.asarray(getattr(model, field)) for field in _FIELDS[kind]]
    if kind == "damping":
        if odd := [columns[0][i] for i in chosen if model.dof_dampingpoly[model.jnt_dofadr[i]].any()]:
            raise ValueError(f"varied: {name!r} changes joints with linear damping; that of {odd[0]!r} is polynomial")
        chosen_numbers = [numbers[0][np.isin(model.dof_jntid, chosen)]]
    else:
        chosen_numbers = [each[chosen] for each in numbers if len(each) == len(columns[0])]
    if not any(each.any() for each in chosen_numbers):
        raise ValueError(f"varied: {name!r} changes nothing: the {kind} there is 0")
    return chosen


def _of_field(model: mujoco.MjModel, field: str, of_kind: np.ndarray, none: int) -> np.ndarray:
    """Indices [n, 2] of the factors of a field's entries, given the indices of the objects' factors."""
    if field == "dof_damping":
        of_kind = of_kind[model.dof_jntid]
    elif field == "pair_friction":
        first, second = of_kind[model.pair_geom1], of_kind[model.pair_geom2]
        return np.stack([np.where(first < none, first, second), np.where(second < none, second, first)], axis=1)
    return np.stack([of_kind, of_kind], axis=1)


def to_ranges(varied: Mapping[str, Sequence[float]] | str) -> dict[str, tuple[float, float]]:
    """Lowest and highest factor of each name, from a mapping or a text such as "mass:box=0.5-2, gain:*=0.9-1.1".

    Raises:
      ValueError: `varied` has another form, or a range is invalid.
    """
    if isinstance(varied, str):
        varied = _parsed(varied)
    if not isinstance(varied, Mapping) or not all(isinstance(name, str) for name in varied):
        raise ValueError(f"varied must map names to (low, high), such as {{'mass:box': (0.5, 2)}}; got {varied!r}")
    ranges = {}
    for name, given in varied.items():
        if np.ndim(given) != 1 or len(given) != 2:
            raise ValueError(f"varied: {name!r} must be (low, high); got {given!r}")
        ends = [end.item() if isinstance(end, np.generic) else end for end in given]
        above = "(0" if name.startswith("mass:") else "[0"
        for end in ends:
            check_number(f"varied {name!r}", end, f"{above}, 1000]", float)
        if ends[0] > ends[1]:
            raise ValueError(f"varied: {name!r} must be (low, high) with low <= high; got {given!r}")
        ranges[name] = (float(ends[0]), float(ends[1]))
    return ranges


def check_friction(model: mujoco.MjModel, ranges: Mapping[str, tuple[float, float]], engine: str) -> None:
    """Raises ValueError if the lowest friction of `ranges` is too low for an engine."""
    lows = {name: low for name, (low, _) in ranges.items() if name.startswith("friction:")}
    lowest = Variation(model, list(lows)).changed(model, np.array([*lows.values()]) - 1)
    for what in too_slippery(lowest, engine):
        cure = 'path="graph" or ' if engine == "warp" and not too_slippery(lowest, "warp graph") else ""
        told = f"engine {engine} does not support {what}, which the lowest factors give"
        raise ValueError(f"varied: {told}; use {cure}engine native")


def draw(ranges: Mapping[str, tuple[float, float]], key: PRNGKey) -> Array:
    """Draws a factor [size] for each of `ranges`, uniform between its ends. Other draws with `key` do not depend on it."""
    low, high = np.array(list(ranges.values()), np.float32).T
    return jax.random.uniform(jax.random.fold_in(key, 0x56415259), low.shape, jnp.float32, low, high)


def _parsed(text: str) -> dict[str, tuple[float, float]]:
    parts = [re.fullmatch(r"\s*([^=]+)=([\d.]+)-([\d.]+)\s*", part) for part in text.split(",")]
    try:
        ranges = [(part[1], (float(part[2]), float(part[3]))) for part in parts]  # type: ignore[index]
        if len(dict(ranges)) < len(ranges):
            raise ValueError("a name is there twice")
        return dict(ranges)
    except (TypeError, ValueError):
        form = "mass:box=0.5-2,gain:*=0.9-1.1"
        raise ValueError(f'varied must be a mapping, or a text such as "{form}"; got {text!r}') from None
