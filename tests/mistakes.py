"""Parts as users get them wrong, each with a word of what it must be told. `test_mistakes` hands them to the checks and to
`train`."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_dher import samplers
from mjx_dher.learners import ddpg
from mjx_dher.networks import mlp
from point_mass import PointMass
from probes import Least

# Samplers: log_weights(achieved [T+1, G], desired [G], step [], hparams) -> [T+1].


def _future(achieved, step):
    return jnp.arange(achieved.shape[0]) > step


def scalar(achieved, desired, step, hparams):
    return jnp.zeros(())


def one_for_each_number(achieved, desired, step, hparams):
    return jnp.zeros(achieved.shape)


def nan_late(achieved, desired, step, hparams):
    return jnp.where(step > 5, jnp.nan, samplers.future(achieved, desired, step, hparams))


def infinite(achieved, desired, step, hparams):
    return jnp.where(_future(achieved, step), jnp.inf, -jnp.inf)


def nothing(achieved, desired, step, hparams):
    return jnp.full(achieved.shape[0], -jnp.inf)


def whole_numbers(achieved, desired, step, hparams):
    return _future(achieved, step).astype(jnp.int32)


def python_if(achieved, desired, step, hparams):
    if step > 3:
        return jnp.zeros(achieved.shape[0])
    return samplers.future(achieved, desired, step, hparams)


def raising(achieved, desired, step, hparams):
    return hparams.radius * achieved[:, 0]


def two_arguments(achieved, desired):
    return jnp.zeros(achieved.shape[0])


SAMPLERS = {
    "scalar": r"sampler: log weights \[T\+1\] .* \[11\]; got float32\[\]",
    "one_for_each_number": r"log weights .* float32\[11, 2\]",
    "nan_late": "at step 6 is nan",
    "infinite": "step 0 is inf",
    "nothing": "offers no goal at any step",
    "whole_numbers": r"log weights .* floats .* int32\[11\]",
    "python_if": r"JAX traces the function.*mistakes.py, line",
    "raising": r"AttributeError: .*radius.*mistakes.py, line",
    "two_arguments": r"sampler must be a function \(achieved, desired, step, hparams\)",
}

# Metrics: (achieved [T+1, G], desired [G]) -> [T+1].


def without_axis(achieved, desired):
    return jnp.linalg.norm(achieved - desired)


def without_norm(achieved, desired):
    return achieved - desired


def similarity(achieved, desired):
    return -jnp.linalg.norm(achieved - desired, axis=-1)


def cosine(achieved, desired):
    return jnp.arccos(2 + 0 * achieved[:, 0])


def constant(achieved, desired):
    return jnp.ones(achieved.shape[0])


def fewer(achieved, desired):
    return jnp.linalg.norm(jnp.diff(achieved, axis=0), axis=-1)


def in_numpy(achieved, desired):
    return [float(x) for x in achieved[:, 0]]


METRICS = {
    "without_axis": r"metric: distances \[T\+1\] .* \[11\]; got float32\[\]",
    "without_norm": r"metric: distances .* float32\[11, 2\]",
    "similarity": "must not be negative",
    "cosine": "must be finite",
    "constant": "tells no goals apart",
    "fewer": r"metric: distances .* float32\[10\]",
    "in_numpy": "ConcretizationTypeError",
}

# Kernels: (relative distance [T+1], temperature []) -> log weight [T+1].


def mean_weight(relative, temperature):
    return -jnp.mean(relative) / temperature


def log_of_negative(relative, temperature):
    return jnp.log(1.0 - relative / temperature)


def pole(relative, temperature):
    return 1.0 / relative - temperature


def too_narrow(relative, temperature):
    return jnp.where(relative > 1e3 * temperature, 0.0, -jnp.inf)


def deaf(relative, temperature):
    return jnp.zeros_like(relative)


def one_argument(relative):
    return -relative


def mask_alone(relative, temperature):
    return relative < temperature


KERNELS = {
    "mean_weight": r"weight_kernel: log weights .* \[31\]; got float32\[\]",
    "log_of_negative": "is nan at relative distance",
    "pole": "is inf at relative distance 0",
    "too_narrow": "takes no goal",
    "deaf": "tells no distances apart",
    "one_argument": r"weight_kernel must be a function \(relative, temperature\)",
    "mask_alone": r"log weights .* floats .* bool\[31\]",
}

# Normalizations: (distance [T+1], candidates [T+1], scale []) -> relative distance [T+1].


def by_least(distance, candidates, scale):
    return distance / jnp.min(jnp.where(candidates, distance, jnp.inf))


NORMALIZATIONS = {"by_least": "not finite, for distances of 0 throughout"}

# Priorities: (episode, compute_reward, hparams) -> [].


def of_each_step(episode, context):
    return context.compute_reward(episode.achieved_goal, episode.desired_goal) + 1.0


def negative(episode, context):
    return jnp.sum(context.compute_reward(episode.achieved_goal, episode.desired_goal))


def division(episode, context):
    return 1.0 / jnp.sum(0.0 * episode.action)


def no_such_field(episode, context):
    return episode.rewards.sum()


def on_the_host(episode, context):
    return float(episode.action.sum()) ** 2


def other_arguments(episode):
    return jnp.ones(())


PRIORITY = {
    "of_each_step": r"priority: weight \[\] .* float32\[11\]",
    "negative": "must not be negative",
    "division": "must be finite",
    "no_such_field": r"AttributeError: .*rewards.*mistakes.py, line",
    "on_the_host": "ConcretizationTypeError",
    "other_arguments": r"priority must be a function \(episode, context\)",
}

# Learners: make(config, spec, networks) -> Learner. Each is `Least`, or the last one DDPG, but for one method.


def _but(**methods):
    return lambda config, spec, networks: type("Own", (Least,), methods)()


keeps_axis = _but(act=lambda self, state, obs, hparams: Least.act(self, state, obs, hparams)[..., None])
unbounded = _but(act=lambda self, state, obs, hparams: 10.0 + Least.act(self, state, obs, hparams))
forgets = _but(update=lambda self, state, batch, hparams: (state, Least.update(self, state, batch, hparams)[1]))
loses = _but(update=lambda self, state, batch, hparams: Least.update(self, state, batch, hparams)[0])
halves = _but(update_target=lambda self, state, hparams: jax.tree.map(lambda x: x.astype("float16"), state))
losses_of_each = _but(
    update=lambda self, state, batch, hparams: (
        Least.update(self, state, batch, hparams)[0],
        {"critic_loss": jnp.zeros(batch.reward.shape)},
    )
)
breaks = _but(
    update=lambda self, state, batch, hparams: (
        jax.tree.map(lambda x: x / 0, state),
        Least.update(self, state, batch, hparams)[1],
    )
)
noise_by_env = _but(
    noise=lambda self, key, num_steps, num_envs, hparams: jax.tree.map(
        lambda x: jnp.moveaxis(x, 0, 1), Least.noise(self, key, num_steps, num_envs, hparams)
    )
)
exports_a_dict = _but(export=lambda self, state, hparams: state)


class _ExportsAnother(ddpg.DDPG):
    def export(self, state, hparams):
        return super().export(state.replace(params=jax.tree.map(lambda x: -x, state.params)), hparams)


def exports_another(config, spec, networks):
    learner = ddpg.make(config, spec, networks)
    return _ExportsAnother(**{field.name: getattr(learner, field.name) for field in dataclasses.fields(learner)})


least = _but()  # right


def methodless(config, spec, networks):
    return object()


LEARNERS = {
    "unbounded": r"in \[-1, 1\]; one is",
    "keeps_axis": r"actions .* float32\[16, 2, 1\]",
    "forgets": "must change the state",
    "loses": r"must return \(state, metrics\)",
    "halves": "must keep structure, shapes and types",
    "losses_of_each": r"critic_loss of learner.update must be numbers of shape \[\]; got float32\[8\]",
    "breaks": "must be finite",
    "noise_by_env": r"must return arrays that lead with \[T, N\]",
    "exports_a_dict": r"must give a policy.Policy or None; it gives a dict",
    "exports_another": "must act as learner.act does",
    "methodless": "is no learner: it has no init",
}

# Networks: make(action_size, hidden_sizes, dtype) -> Networks.


def one_action(action_size, hidden_sizes, dtype):
    return mlp(1, hidden_sizes, dtype)


def swapped(action_size, hidden_sizes, dtype):
    made = mlp(action_size, hidden_sizes, dtype)
    return made._replace(actor=made.critic, critic=made.actor)


NETWORKS = {"one_action": r"the actor must give \[2, 2\]", "swapped": "raises TypeError"}

# Environments: each is the point mass but for one thing.


def _point(**changes):
    return type("Own", (PointMass,), changes)


def _changed(name, change):
    """A point mass whose states, from the first or from the first step on, have something else for `name`."""

    def replaced(state):
        if name in ("reward", "success"):
            return state.replace(**{name: change(getattr(state, name))})
        return state.replace(obs={**state.obs, name: change(state.obs[name])})

    return {
        "reset": lambda self, key: replaced(PointMass.reset(self, key)),
        "step": lambda self, state, action: replaced(PointMass.step(self, state, action)),
    }


def _later(change):
    return {"step": lambda self, state, action: change(PointMass.step(self, state, action))}


NanObservation = _point(**_changed("observation", lambda x: x * jnp.nan))
SuccessSeven = _point(**_changed("success", lambda x: x + 7))
NanSuccess = _point(**_changed("success", lambda x: x * jnp.nan))
RewardOfTwoAxes = _point(**_changed("reward", lambda x: x[None]))
ShorterGoal = _point(**_changed("desired_goal", lambda x: x[:1]), goal_size=2)
Growing = _point(**_later(lambda s: s.replace(obs={**s.obs, "observation": jnp.tile(s.obs["observation"], 2)})))
Raising = _point(**_later(lambda s: s.no_such_thing))
NoActions = _point(action_size=0)
NoSteps = _point(__init__=lambda self: PointMass.__init__(self, episode_length=0))
Positive = _point(compute_reward=lambda self, a, d: 1.0 + PointMass.compute_reward(self, a, d))
Hundred = _point(compute_reward=lambda self, a, d: 100.0 * PointMass.compute_reward(self, a, d))
WithoutAxis = _point(
    compute_reward=lambda self, a, d: -(jnp.linalg.norm(a - d) > 0.1).astype(jnp.float32),
)
NanReward = _point(compute_reward=lambda self, a, d: jnp.where(a[..., 0] > d[..., 0], jnp.nan, -1.0))

HalfNan = _point(  # its check would raise, too; here it is for training
    step=lambda self, state, action: _half(PointMass.step(self, state, action)),
)


def _half(state):
    x = jnp.where(state.obs["desired_goal"][0] > 0, jnp.nan, state.obs["observation"])
    return state.replace(obs={**state.obs, "observation": x})


ENVS = {
    "NanObservation": "observation must be finite",
    "SuccessSeven": "success must be 0 or 1; it takes",
    "NanSuccess": "success must be finite",
    "RewardOfTwoAxes": r"reward must be a scalar, \[\]",
    "ShorterGoal": r"achieved_goal and desired_goal .* \(2,\) and \(1,\)",
    "Growing": "must keep structure, shapes and types",
    "Raising": "AttributeError.*no_such_thing",
    "NoActions": "action_size must be an integer of at least 1; it is 0",
    "NoSteps": "episode_length must be an integer of at least 1; it is 0",
    "Positive": r"rewards .* \[-1, 0\]; .* 0 to 1",
    "Hundred": r"rewards .* \[-1, 0\]; .* -100",
    "WithoutAxis": r"compute_reward of goals \[3, 2\] .* \[3\]; got float32\[\]",
    "NanReward": "must be finite",
}
