import types

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from mjx_dher.config import HParams
from mjx_dher.learners import actors, ddpg
from mjx_dher.learners.actors import Deterministic
from mjx_dher.learners.common import Params
from mjx_dher.learners.ddpg import DDPG
from mjx_dher.networks import Actor, Critic, Networks, fan_in, mlp
from mjx_dher.types import Batch
from probes import BATCH, LinearActor, spec_of

HP = HParams(gamma=0.5, action_l2=0.25)
BOUNDS = (-2.0, 0.0)


class LinearCritic(nn.Module):
    """a * observation + b * goal + c * action."""

    @nn.compact
    def __call__(self, observation, goal, action):
        abc = self.param("abc", lambda _: jnp.array([-0.5, 0.25, 0.5]))
        return (abc[0] * observation + abc[1] * goal + abc[2] * action)[..., 0]


NETWORKS = Networks(actor=LinearActor(), critic=LinearCritic())
LEARNER = DDPG(spec_of(1, 1, 1), NETWORKS, NETWORKS)
update = jax.jit(LEARNER.update)


@pytest.fixture
def state():
    return LEARNER.init(jax.random.key(0))


def losses_of(batch, state, hparams=HP):
    return ddpg.compute_gradients(NETWORKS, state.params, state.target, batch, BOUNDS, hparams)[1]


Q = np.array([-0.25, -1.5])  # of the batch: -0.5 - 0.25 + 0.5 and 0 - 1 - 0.5


def test_losses_by_hand(state):
    losses = losses_of(BATCH, state)
    # Q' of the next states: -0.5 * 0 - 0.25 + 0.5 * tanh(0) = -0.25 and -1 - 1 + 0.5 * tanh(2).
    y = np.array([-1 + 0.5 * -0.25, 0.5 * (-2 + 0.5 * np.tanh(2))])
    np.testing.assert_allclose([losses["critic_loss"], losses["q_mean"]], [np.mean((Q - y) ** 2), -0.875], rtol=1e-6)
    # pi: tanh(1) and 0; Q: -0.75 + tanh(1) / 2 and -1.
    a = np.tanh(1.0)
    np.testing.assert_allclose(losses["actor_loss"], -((-0.75 + a / 2) - 1) / 2 + 0.25 * a * a / 2, rtol=1e-6)


@pytest.mark.parametrize(("reward", "clipped"), [(-9.0, -2.0), (9.0, 0.0)])
def test_targets_are_clipped_to_what_returns_can_be(state, reward, clipped):
    loss = losses_of(BATCH.replace(reward=jnp.full(2, reward)), state)["critic_loss"]
    np.testing.assert_allclose(loss, np.mean((Q - clipped) ** 2), rtol=1e-6)


def test_update_is_one_adam_step_of_both_from_the_old_parameters(state):
    updated, losses = update(state, BATCH, HP._replace(critic_lr=0.1, actor_lr=0.01))
    gradients, _ = ddpg.compute_gradients(NETWORKS, state.params, state.target, BATCH, BOUNDS, HP)
    # Adam's first step moves each parameter by the step size, against the sign of its gradient.
    for name, lr in (("critic", 0.1), ("actor", 0.01)):
        step = lambda new, old, g, lr=lr: np.testing.assert_allclose(new, old - lr * np.sign(g), rtol=1e-4)  # noqa: E731
        jax.tree.map(step, *(getattr(x, name) for x in (updated.params, state.params, gradients)))
    jax.tree.map(np.testing.assert_array_equal, updated.target, state.target)
    assert updated.num_updates == 1
    assert losses.keys() == {"critic_loss", "actor_loss", "q_mean"}
    np.testing.assert_allclose(losses["q_mean"], -0.875, rtol=1e-6)


def test_a_subclass_s_gradients_are_used(state):
    class Own(DDPG):
        def gradients(self, *args):
            gradients, metrics = ddpg.compute_gradients(*args)
            return gradients, metrics | {"own_metric": jnp.float32(3)}

    _, metrics = Own(spec_of(1, 1, 1), NETWORKS, NETWORKS).update(state, BATCH, HP)
    assert metrics["own_metric"] == 3


def test_gradients_are_those_of_each_loss_by_its_own_network(state):
    """By differences: a step along one network's parameters changes the loss by its gradient, and the other does not count."""
    gradients, _ = ddpg.compute_gradients(NETWORKS, state.params, state.target, BATCH, BOUNDS, HP)
    for name, loss in (("critic", "critic_loss"), ("actor", "actor_loss")):
        moved = [jax.tree.map(lambda x, d=d: x + d, getattr(state.params, name)) for d in (0.01, -0.01)]
        up, down = (losses_of(BATCH, state.replace(params=state.params.replace(**{name: params}))) for params in moved)
        slope = (up[loss] - down[loss]) / 0.02
        np.testing.assert_allclose(slope, sum(x.sum() for x in jax.tree.leaves(getattr(gradients, name))), rtol=1e-3)


def test_summed_gradients_are_averaged_ones_with_a_smaller_adam_eps(state, monkeypatch):
    """Of 8 workers: 8 times the gradient, by Adam with eps 1e-3, is the gradient, by Adam with eps 1e-3 / 8."""
    of_sum, of_mean, of_default, one = state, state, state, ddpg.compute_gradients
    for _ in range(5):
        with monkeypatch.context() as patch:
            patch.setattr(DDPG, "gradients", staticmethod(lambda *args: _times(8.0, *one(*args))))
            of_sum, _ = LEARNER.update(of_sum, BATCH, HP._replace(adam_eps=1e-3))
        of_mean, _ = LEARNER.update(of_mean, BATCH, HP._replace(adam_eps=1e-3 / 8))
        of_default, _ = LEARNER.update(of_default, BATCH, HP._replace(adam_eps=1e-3))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), of_sum.params, of_mean.params)
    moved = ravel_pytree(of_mean.params)[0] - ravel_pytree(of_default.params)[0]
    assert float(jnp.abs(moved).max()) > 1e-6  # and not the same as with the larger one


def _times(factor, gradients, losses):
    return jax.tree.map(lambda x: factor * x, gradients), losses


def test_update_normalizes_what_the_networks_see(state):
    state = LEARNER.update_normalizers(state, jnp.array([[-2.0], [6.0]]), jnp.array([[1.0], [1.0]]), HP)
    np.testing.assert_allclose(state.observation_norm.mean, [2.0])
    action = LEARNER.act(state, {"observation": jnp.array([4.0]), "desired_goal": jnp.array([1.0])}, HP)
    np.testing.assert_allclose(action, [np.tanh(0.5)], rtol=1e-6)  # (4 - 2) / 4
    _, losses = update(state, BATCH, HP)
    # Observations (1 - 2) / 4 and -2 / 4; goals (-1 - 1) / 0.01 and -5 / 0.01, both clipped to -5.
    q = [-0.5 * -0.25 + 0.25 * -5 + 0.5, -0.5 * -0.5 + 0.25 * -5 - 0.5]
    np.testing.assert_allclose(losses["q_mean"], np.mean(q), rtol=1e-6)


def test_soft_update(state):
    moved = state.replace(params=jax.tree.map(lambda x: x + 1.0, state.params))
    target = LEARNER.update_target(moved, HP._replace(polyak=0.75)).target
    jax.tree.map(lambda new, old: np.testing.assert_allclose(new, old + 0.25, rtol=1e-6), target, state.target)


def test_the_summary_is_the_norms_of_all_parameters(state):
    summary = LEARNER.summary(state)
    assert summary.keys() == {"actor_norm", "critic_norm"}
    np.testing.assert_allclose(summary["actor_norm"], 1.0)
    np.testing.assert_allclose(summary["critic_norm"], np.sqrt(0.25 + 0.0625 + 0.25), rtol=1e-6)


def test_exploring_is_acting_under_noise(state):
    """The noise of one step: to the first action it is added, and the second one takes its place."""
    noise = actors.Noise(jnp.array([[0.1], [0.1]]), jnp.array([False, True]), jnp.array([[0.9], [-0.9]]))
    obs = {"observation": jnp.array([[0.5], [0.5]]), "desired_goal": jnp.zeros((2, 1))}
    action = LEARNER.explore(state, obs, noise, HP)
    np.testing.assert_allclose(action, [LEARNER.act(state, obs, HP)[0] + 0.1, [-0.9]], rtol=1e-6)
    whole = LEARNER.noise(jax.random.key(0), 3, 2, HP)
    jax.tree.map(np.testing.assert_array_equal, whole, actors.exploration_noise(jax.random.key(0), 3, 2, 1, HP))


def explored(noise, policy):
    """Actions of a policy that gives `policy`, under noise."""
    network = types.SimpleNamespace(apply=lambda params, observation, goal: observation)
    return Deterministic().explore(network, (), policy, policy, noise)


def make_noise(**hparams):
    return actors.exploration_noise(jax.random.key(1), 100, 1000, 2, HParams(**hparams))


def test_exploration_is_a_mixture_of_uniform_and_clipped_gaussian():
    policy = jnp.tile(jnp.array([0.0, 0.9]), (100, 1000, 1))
    noisy = explored(make_noise(random_eps=0.0, noise_std=0.2), policy)
    assert abs(float(noisy[..., 0].std()) - 0.2) < 0.002
    assert abs(float(noisy[..., 0].mean())) < 0.002
    assert float(noisy.max()) == 1.0
    uniform = explored(make_noise(random_eps=1.0, noise_std=0.2), policy)
    assert abs(float(uniform.mean())) < 0.005
    assert abs(float(uniform.std()) - 1 / np.sqrt(3)) < 0.005
    mixed = explored(make_noise(random_eps=0.3, noise_std=0.0), policy)
    is_random = ~np.asarray(mixed == policy).all(-1)
    assert abs(is_random.mean() - 0.3) < 0.006
    np.testing.assert_array_equal(np.asarray(mixed != policy).any(-1), is_random)  # an action is random as a whole


def test_random_actions_have_a_fraction_of_the_noise_and_stay_within_bounds():
    """Without it, the same random actions; at 1, those and all of the noise, clipped."""
    plain, whole, half = (make_noise(noise_std=0.2, random_noise=fraction) for fraction in (0.0, 1.0, 0.5))
    for noise in (whole, half):
        np.testing.assert_array_equal(noise.gaussian, plain.gaussian)
        np.testing.assert_array_equal(noise.is_random, plain.is_random)
    np.testing.assert_array_equal(whole.uniform, jnp.clip(plain.uniform + plain.gaussian, -1, 1))
    np.testing.assert_allclose(half.uniform, jnp.clip(plain.uniform + 0.5 * plain.gaussian, -1, 1), atol=1e-7)
    assert 0.01 < float(jnp.mean(jnp.abs(whole.uniform) == 1.0)) < 0.2


def test_every_step_tosses_its_own_coin():
    is_random = np.asarray(make_noise(random_eps=0.3).is_random)
    assert abs(np.mean(is_random[1:] & is_random[:-1]) - 0.09) < 0.004


def test_paper_networks():
    actor, critic = Actor(4), Critic()
    obs, goal, action = jnp.zeros((7, 25)), jnp.zeros((7, 3)), jnp.zeros((7, 4))
    actor_params = jax.jit(actor.init)(jax.random.key(0), obs, goal)
    critic_params = jax.jit(critic.init)(jax.random.key(1), obs, goal, action)
    act, judge = jax.jit(actor.apply), jax.jit(critic.apply)
    assert act(actor_params, obs, goal).shape == (7, 4)
    assert judge(critic_params, obs, goal, action).shape == (7,)

    def kernels(params):
        return [params["params"][f"Dense_{i}"]["kernel"].shape for i in range(4)]

    assert kernels(actor_params) == [(28, 256), (256, 256), (256, 256), (256, 4)]
    assert kernels(critic_params) == [(32, 256), (256, 256), (256, 256), (256, 1)]
    assert np.abs(act(actor_params, obs + 1e6, goal)).max() <= 1.0


def test_fan_in_begins_as_pytorch_s_linear_layers_do():
    """Weights and biases are uniform in +-1/sqrt(inputs); of those of `mlp` biases are 0 and weights Xavier's."""
    obs, goal, action = jnp.zeros(25), jnp.zeros(3), jnp.zeros(4)
    for networks, bound_of in ((fan_in, lambda i, o: i**-0.5), (mlp, lambda i, o: (6 / (i + o)) ** 0.5)):
        made = networks(4, (256, 256, 256))
        actor, critic = jax.jit(made.actor.init), jax.jit(made.critic.init)
        both = actor(jax.random.key(0), obs, goal), critic(jax.random.key(1), obs, goal, action)
        for params in jax.device_get(both):
            for layer in params["params"].values():
                bound = bound_of(*layer["kernel"].shape)
                assert 0.95 * bound < np.abs(layer["kernel"]).max() <= bound
                assert abs(layer["kernel"].std() - bound / np.sqrt(3)) < 0.05 * bound
                bias = np.abs(layer["bias"]).max()
                assert bias == 0 if networks is mlp else 0 < bias <= bound
    assert isinstance(made.actor, Actor)  # so that kernels and exported policies are what they are


def test_gradients_in_bfloat16_are_those_of_float32_but_for_rounding():
    """8 bits of mantissa: values to half a per cent, and directions of gradients within five degrees."""
    exact, rounded = (mlp(4, (256, 256, 256), dtype) for dtype in ("float32", "bfloat16"))
    params = jax.jit(DDPG(spec_of(25, 3, 4), exact, rounded).init)(jax.random.key(0)).params
    observation, following, goal, action = (
        jax.random.normal(jax.random.key(i), (512, size)) for i, size in enumerate((25, 25, 3, 4))
    )
    batch = Batch(observation, following, goal, jnp.tanh(action), -jnp.ones(512), jnp.full(512, 0.98), jnp.arange(512))
    hparams = HParams()

    def passes(networks):
        act, judge = jax.jit(networks.actor.apply), jax.jit(networks.critic.apply)
        action = act(params.actor, observation, goal)
        assert action.dtype == judge(params.critic, observation, goal, action).dtype == jnp.float32
        compute = jax.jit(lambda params, batch: ddpg.compute_gradients(networks, params, params, batch, (-50.0, 0.0), hparams))
        gradients, losses = compute(params, batch)
        return losses["critic_loss"], ravel_pytree(gradients.critic)[0], ravel_pytree(gradients.actor)[0]

    (loss, *gradients), (near, *others) = passes(exact), passes(rounded)
    assert 0 < abs(float(loss - near)) < 0.05 * float(loss)
    for ours, other in zip(gradients, others, strict=True):
        assert other.dtype == jnp.float32
        assert float(ours @ other / jnp.linalg.norm(ours) / jnp.linalg.norm(other)) > np.cos(np.radians(5))


def test_critic_learns_a_known_value():
    """A chain whose every step costs 1 and leads to itself: Q = -1 / (1 - gamma), whatever the action."""
    networks = mlp(1, (16,))
    learner = DDPG(spec_of(1, 1, 1), networks, networks)
    state = learner.init(jax.random.key(0))
    hparams = HParams(gamma=0.8, polyak=0.9, critic_lr=0.01)
    ones = jnp.ones((32, 1))

    @jax.jit
    def step(state, key):
        action = jax.random.uniform(key, (32, 1), minval=-1, maxval=1)
        state, losses = learner.update(
            state, Batch(ones, ones, ones, action, -jnp.ones(32), jnp.full(32, hparams.gamma), jnp.arange(32)), hparams
        )
        return learner.update_target(state, hparams), losses

    state, losses = jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 1500))
    np.testing.assert_allclose(losses["q_mean"][-100:].mean(), -5.0, atol=0.1)
    assert isinstance(state.params, Params)
