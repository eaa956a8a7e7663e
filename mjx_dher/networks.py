"""Actor and critic networks. The default `mlp` has four linear layers, as in the paper, with ReLU between them."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from mjx_dher import components
from mjx_dher.lookup import check_function
from mjx_dher.types import Array, EnvSpec, PRNGKey, PyTree


class Style(NamedTuple):
    """How hidden layers are built."""

    layer_norm: bool = False  # normalizes each layer before its activation
    fan_in: bool = False  # draws the first weights and biases as PyTorch does (`fan_in`)
    residual: bool = False  # swish, and blocks of two layers with a skip connection around them (`residual`)

    @property
    def is_plain(self) -> bool:
        """Whether there are only linear layers and ReLU, which a `policy.Policy` can hold."""
        return not (self.layer_norm or self.residual)


def _mlp(x: Array, hidden_sizes: Sequence[int], output_size: int, dtype: DTypeLike, style: Style) -> Array:
    activation = nn.swish if style.residual else nn.relu
    linear: Any = nn.Dense
    if style.layer_norm:
        from mjx_dher import layers  # on demand: most runs do without

        linear = layers.Dense
    skipped: Any = None
    for number, size in enumerate(hidden_sizes):
        x = linear(size, dtype=dtype, **_initializers(x, style.fan_in))(x)
        x = activation(layers.LayerNorm(dtype)(x) if style.layer_norm else x)
        if style.residual and number % 2 == 0:
            x = skipped = x if skipped is None else x + skipped
    return linear(output_size, dtype=jnp.float32, **_initializers(x, style.fan_in))(x)


def _initializers(x: Array, fan_in: bool) -> dict[str, Any]:
    """Initializers of a layer with inputs `x` [..., I]: Xavier's without bias, or uniform in +-1/sqrt(I)."""
    if not fan_in:
        return {"kernel_init": nn.initializers.xavier_uniform()}
    bound = x.shape[-1] ** -0.5

    def uniform(key: PRNGKey, shape: Sequence[int], dtype: DTypeLike = jnp.float32) -> Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return {"kernel_init": uniform, "bias_init": uniform}


class Actor(nn.Module):
    """Deterministic policy: normalized observation and goal to an action in [-1, 1]. Parameters and actions are float32."""

    action_size: int
    hidden_sizes: Sequence[int] = (256, 256, 256)
    dtype: DTypeLike = jnp.float32  # of the hidden layers' products and activations
    style: Style = Style()

    @nn.compact
    def __call__(self, observation: Array, goal: Array) -> Array:
        """Maps observations [..., D] and goals [..., G] to actions [..., A]."""
        inputs = jnp.concatenate([observation, goal], axis=-1)
        return jnp.tanh(_mlp(inputs, self.hidden_sizes, self.action_size, self.dtype, self.style))


class GaussianActor(nn.Module):
    """Gaussian policy before tanh: maps normalized observation and goal to means and log standard deviations, in float32."""

    action_size: int
    hidden_sizes: Sequence[int] = (256, 256, 256)
    dtype: DTypeLike = jnp.float32  # of the hidden layers' products and activations
    style: Style = Style()

    @nn.compact
    def __call__(self, observation: Array, goal: Array) -> tuple[Array, Array]:
        """Maps observations [..., D] and goals [..., G] to means [..., A] and log standard deviations [..., A]."""
        inputs = jnp.concatenate([observation, goal], axis=-1)
        outputs = _mlp(inputs, self.hidden_sizes, 2 * self.action_size, self.dtype, self.style)
        return outputs[..., : self.action_size], outputs[..., self.action_size :]


class Critic(nn.Module):
    """Q value of an action in a state for a goal, or quantiles of the return. Parameters and values are float32."""

    hidden_sizes: Sequence[int] = (256, 256, 256)
    dtype: DTypeLike = jnp.float32  # of the hidden layers' products and activations
    size: int | None = None  # outputs M; None: one output without an axis
    style: Style = Style()

    @nn.compact
    def __call__(self, observation: Array, goal: Array, action: Array) -> Array:
        """Maps observations [..., D], goals [..., G] and actions [..., A] to values [...] or [..., M]."""
        inputs = jnp.concatenate([observation, goal, action], axis=-1)
        values = _mlp(inputs, self.hidden_sizes, self.size or 1, self.dtype, self.style)
        return values[..., 0] if self.size is None else values


class Encoders(nn.Module):
    """A contrastive critic's encoders: of an observation and an action, and of a goal. Parameters are float32."""

    hidden_sizes: Sequence[int]
    dtype: DTypeLike  # of the hidden layers' products and activations
    size: int  # R
    style: Style = Style()

    @nn.compact
    def __call__(self, observation: Array, goal: Array, action: Array) -> tuple[Array, Array]:
        """Maps observations [..., D], goals [..., G] and actions [..., A] to phi [..., R] and psi [..., R]."""
        tower = functools.partial(_Tower, self.hidden_sizes, self.dtype, self.size, self.style)
        return tower(name="phi")(jnp.concatenate([observation, action], axis=-1)), tower(name="psi")(goal)


class _Tower(nn.Module):
    hidden_sizes: Sequence[int]
    dtype: DTypeLike
    size: int
    style: Style

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return _mlp(x, self.hidden_sizes, self.size, self.dtype, self.style)


class Networks(NamedTuple):
    """Flax modules of actor and critic, which are static. Their inputs are normalized."""

    actor: Any  # (observation [..., D], goal [..., G]) -> action [..., A] in [-1, 1], or as in `Heads`
    critic: Any  # (observation [..., D], goal [..., G], action [..., A]) -> value [...], or as in `Heads`
    # Module or function from an observation tree to a vector [..., D]. Actor and critic train one each.
    # Without it, observations are float vectors, or trees of float vectors, which are concatenated.
    encoder: Any = None
    project: Callable[[PyTree], PyTree] | None = None  # of the parameters of actor or critic, after each update


class Encoded(nn.Module):
    """A network behind an encoder of its observations."""

    encoder: Any
    network: Any

    @nn.compact
    def __call__(self, observation: PyTree, *inputs: Array) -> Any:
        """Output of the network for the encoded observation."""
        return self.network(self.encoder(observation), *inputs)


def with_encoder(networks: Networks) -> Networks:
    """Networks whose actor and critic take observation trees, if there is an encoder. Raises ValueError for another object."""
    if not isinstance(networks, Networks):
        raise ValueError(f"networks must return a mjx_dher.networks.Networks; got {networks!r}")
    if networks.encoder is None:
        return networks
    actor, critic = (Encoded(networks.encoder, network) for network in (networks.actor, networks.critic))
    return networks._replace(actor=actor, critic=critic)


class Heads(NamedTuple):
    """Outputs that a learner needs from its networks. The defaults are an action and a value."""

    gaussian: bool = False  # the actor returns (mean [..., A], log standard deviation [..., A]), before tanh
    critic_size: int | None = None  # M: the critic returns values [..., M]
    representation: int | None = None  # R: the critic returns phi [..., R] and psi [..., R], as `Encoders` does


PLAIN = Heads()

# make(action_size, hidden_sizes, dtype) -> Networks; parameters do not depend on the dtype. A fourth argument, heads, is
# needed by learners with other heads than the default.
NetworksFn = Callable[..., Networks]
_PARAMETERS = ("action_size", "hidden_sizes", "dtype")


def mlp(action_size: int, hidden_sizes: tuple[int, ...], dtype: DTypeLike = "float32", heads: Heads = PLAIN) -> Networks:
    """The default networks: linear layers and ReLU for actor and critic.

    Args:
      action_size: A.
      hidden_sizes: units of each hidden layer.
      dtype: of the hidden layers' products and activations. Parameters and outputs are float32.
      heads: outputs that the learner needs.
    """
    return _styled(action_size, hidden_sizes, dtype, heads, Style(), Style())


def layer_norm(action_size: int, hidden_sizes: tuple[int, ...], dtype: DTypeLike = "float32", heads: Heads = PLAIN) -> Networks:
    """`mlp` with layer normalization (Ba et al. 2016) before each ReLU of the critic.

    It bounds the critic's values for actions that it never saw (Ball et al. 2023, RLPD).
    """
    return _styled(action_size, hidden_sizes, dtype, heads, Style(), Style(layer_norm=True))


def fan_in(action_size: int, hidden_sizes: tuple[int, ...], dtype: DTypeLike = "float32", heads: Heads = PLAIN) -> Networks:
    """`mlp` with initial weights and biases uniform in +-1/sqrt(layer inputs), the default of PyTorch's linear layers.

    The code behind the paper's numbers uses PyTorch. Xavier's bound, sqrt(6 / (inputs + outputs)), is 1.7 times as large in a
    square layer, and its biases are 0.
    """
    return _styled(action_size, hidden_sizes, dtype, heads, Style(fan_in=True), Style(fan_in=True))


def residual(action_size: int, hidden_sizes: tuple[int, ...], dtype: DTypeLike = "float32", heads: Heads = PLAIN) -> Networks:
    """Residual networks of any depth, with layer normalization and swish, for actor and critic.

    Each pair of layers after the first has a skip connection around it (He et al. 2016). Deep contrastive critics need all
    three parts (Wang et al. 2025, "1000 Layer Networks for Self-Supervised RL"). Raises ValueError for unequal `hidden_sizes`.
    """
    if len(set(hidden_sizes)) != 1:
        raise ValueError(f"networks residual and unit_norm need equal hidden_sizes; got {hidden_sizes}")
    style = Style(layer_norm=True, residual=True)
    return _styled(action_size, hidden_sizes, dtype, heads, style, style)


def unit_norm(action_size: int, hidden_sizes: tuple[int, ...], dtype: DTypeLike = "float32", heads: Heads = PLAIN) -> Networks:
    """`residual` with the weights of each hidden unit projected to length 1, at first and after each update, as in XQC and
    SimbaV2 (2025).

    Layer normalization makes the outputs independent of a factor common to the units of a layer. Kept at length 1, the weights
    do not grow and shorten the steps.
    """
    return residual(action_size, hidden_sizes, dtype, heads)._replace(project=_to_unit_length)


def _to_unit_length(params: PyTree) -> PyTree:
    """Parameters with columns of length 1 in every linear layer that a layer normalization follows."""
    if not isinstance(params, Mapping):
        return params
    projected = {name: _to_unit_length(value) for name, value in params.items()}
    for name in params:
        if name.startswith("Dense_") and name.replace("Dense", "LayerNorm") in params:
            kernel = params[name]["kernel"]  # [..., in, out]
            length = jnp.sqrt(jnp.sum(jnp.square(kernel), axis=-2, keepdims=True))
            projected[name] = {**params[name], "kernel": kernel / jnp.maximum(length, 1e-8)}
    return projected


def _styled(
    action_size: int, hidden_sizes: tuple[int, ...], dtype: DTypeLike, heads: Heads, actor: Style, critic: Style
) -> Networks:
    own_actor, dtype = GaussianActor if heads.gaussian else Actor, jnp.dtype(dtype)
    judge: Any = Critic(hidden_sizes, dtype, heads.critic_size, critic)
    if heads.representation is not None:
        judge = Encoders(hidden_sizes, dtype, heads.representation, critic)
    return Networks(own_actor(action_size, hidden_sizes, dtype, actor), judge)


def make(name: str | NetworksFn) -> NetworksFn:
    """Loads a function that makes networks: a built-in name, "module:attribute", or a function. Raises ValueError if there are
    no such networks, or it is not a function of (action_size, hidden_sizes, dtype).
    """
    return components.load("networks", name, *_PARAMETERS)


def check_heads(make_networks: NetworksFn, learner: str) -> None:
    """Raises ValueError if custom networks do not take `heads` as a fourth argument, which some learners need."""
    check_function(f"networks for learner {learner} (see networks.Heads)", make_networks, (*_PARAMETERS, "heads"))


def zeros(spec: EnvSpec, networks: Networks, *leading: int) -> tuple[PyTree, Array, Array]:
    """Zero inputs of the networks, with leading axes: observation, goal and action."""
    observation = jax.tree.map(lambda x: jnp.zeros((*leading, *x.shape), x.dtype), spec.observation)
    goal, action = (jnp.zeros((*leading, size)) for size in (spec.goal_size, spec.action_size))
    return concatenated(observation) if networks.encoder is None else observation, goal, action


def concatenated(observation: PyTree) -> Array:
    """Concatenates a tree of vectors to one vector [..., D]."""
    leaves = jax.tree.leaves(observation)
    return leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves, axis=-1)


def check_outputs(learner: str, networks: Networks, spec: EnvSpec, heads: Heads = PLAIN) -> None:
    """Raises ValueError unless networks take the spec's observations and return the outputs in `heads`."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(spec.observation) if networks.encoder is None else ():
        if len(leaf.shape) != 1 or not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"networks: observation{jax.tree_util.keystr(path)} must be a vector of floats for networks without an encoder;"
                f" it is {leaf.dtype}{list(leaf.shape)} (see `encoder` of mjx_dher.networks.Networks)"
            )
    key, (obs, goal, action) = jax.random.key(0), jax.eval_shape(lambda: zeros(spec, networks, 2))
    numbers: Any = (2, spec.action_size)
    for part, inputs, expected in (
        ("actor", (obs, goal), (numbers, numbers) if heads.gaussian else numbers),
        ("critic", (obs, goal, action), _critic_shapes(heads)),
    ):
        output = jax.eval_shape(getattr(networks, part).init_with_output, key, *inputs)[0]
        if jax.tree.map(lambda x: getattr(x, "shape", None), output) != expected:
            raise ValueError(
                f"networks: for learner {learner} the {part} must give {list(expected)} for a batch of 2; it gives {output}"
            )


def _critic_shapes(heads: Heads) -> Any:
    if heads.representation is not None:
        return (2, heads.representation), (2, heads.representation)
    return (2,) if heads.critic_size is None else (2, heads.critic_size)
