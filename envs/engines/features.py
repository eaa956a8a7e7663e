"""Fields of MuJoCo's MjModel that an engine ignores, and that must therefore have their defaults."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

_WORDS = {
    "opt.solver": "a solver other than Newton's",
    "opt.enableflags": "options enabled",
    "opt.density": "a medium",
    "opt.viscosity": "a medium",
    "opt.noslip_iterations": "noslip iterations",
    "opt.disableactuator": "disabled groups of actuators",
    "nflex": "flexes",
    "nplugin": "plugins",
    "nhistory": "delays",
    "na": "activations",
    "actuator_dyntype": "actuators with a state",
    "actuator_gaintype": "actuators whose gain varies",
    "actuator_delay": "delays",
    "body_gravcomp": "gravity compensation",
    "dof_dampingpoly": "damping that is not linear",
    "jnt_stiffnesspoly": "springs that are not linear",
    "pair_adhesion": "contacts that stick",
}
_NEUTRAL = """
<mujoco><worldbody><body name="t" mocap="true"/><body name="b"><joint name="j"/><geom name="g" size="1"/></body>
<geom name="h" size="1"/></worldbody><equality><weld body1="t" body2="b"/></equality>
<contact><pair geom1="g" geom2="h"/></contact><tendon><fixed><joint joint="j" coef="1"/></fixed></tendon>
<actuator><motor joint="j"/></actuator></mujoco>
"""  # an element of each kind, with its defaults


def fields(model: mujoco.MjModel) -> Iterator[tuple[str, Any]]:
    """Names and values of a model's fields, and of its options as `opt.NAME`."""
    for prefix, holder in (("", model), ("opt.", model.opt)):
        for name in dir(holder):
            if not name.startswith("_") and name != "opt" and not callable(value := getattr(holder, name)):
                yield prefix + name, value


@functools.cache
def _defaults() -> dict[str, Any]:
    """Defaults of fields. For fields of elements, the default of one element."""
    per_element = ("actuator_", "body_", "dof_", "eq_", "geom_", "jnt_", "pair_", "tendon_")
    values = dict(fields(mujoco.MjModel.from_xml_string(_NEUTRAL)))
    counts = {name for name in values if name.startswith("n") and name.islower() and "." not in name}
    # The world body comes first, and the default actuator drives its joint.
    return {
        name: value[0] if name.startswith(per_element) else 0 if name in counts else value for name, value in values.items()
    }


def beyond_defaults(model: mujoco.MjModel, concerns: Callable[[str], bool]) -> list[str]:
    """Features of a model whose fields, if `concerns(field)`, do not have their defaults, with their elements."""
    features: list[str] = []
    defaults = _defaults()
    for name, value in fields(model):
        if not concerns(name):
            continue
        words, default = _WORDS.get(name, name), defaults.get(name)
        if default is None or np.ndim(value) == np.ndim(default):
            if default is None or not np.array_equal(value, default):
                features.append(words)
        elif np.any(different := value != default):
            features.append(with_names(words, model, name.split("_")[0], np.unique(np.nonzero(different)[0])))
    return list(dict.fromkeys(features))


def narrow_limits(model: mujoco.MjModel) -> Iterator[str]:
    """Joints and tendons that can be at both limits at once: MuJoCo C has a row for each limit, and other engines one row."""
    for kind in ("jnt", "tendon"):
        limited, span, margin = (getattr(model, f"{kind}_{name}") for name in ("limited", "range", "margin"))
        if (narrow := (limited != 0) & (span[:, 1] - span[:, 0] < 2 * margin)).any():
            yield with_names("limits nearer to each other than twice their margin", model, kind, np.flatnonzero(narrow))


def check_inputs(model: mujoco.MjModel) -> None:
    """Raises ValueError if an actuator has no input or several: then inputs and actuators are numbered differently."""
    if (others := np.flatnonzero(model.actuator_ctrlnum != 1)).size:
        raise ValueError(with_names("every actuator must have one input, unlike some of the model", model, "actuator", others))


def stand_alone(model: mujoco.MjModel) -> np.ndarray:
    """Whether each joint [njnt] is of a free body without other joints on it."""
    tree = model.body_treeid[model.jnt_bodyid]
    return (model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)) & (model.tree_dofnum[np.maximum(tree, 0)] == 6)


def with_names(what: str, model: mujoco.MjModel, kind: str, indices: Any) -> str:
    """`what`, followed by names of elements, or by their numbers if they have none."""
    if kind == "dof":
        kind, indices = "jnt", np.unique(model.dof_jntid[indices])
    if kind == "pair":
        kind, indices = "geom", np.unique([model.pair_geom1[indices], model.pair_geom2[indices]])
    word = {"jnt": "joint", "eq": "equality"}.get(kind, kind)
    names = [getattr(model, word)(int(index)).name for index in indices]
    shown = [repr(name) if name else f"{word} {index}" for name, index in zip(names, indices)]
    return f"{what} ({', '.join([*shown[:5], '...'] if len(shown) > 5 else shown)})" if shown else what
