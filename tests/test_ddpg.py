import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from mjx_dher.config import HParams
from mjx_dher.learners import common, ddpg
from mjx_dher.learners.common import Params
from mjx_dher.learners.ddpg import DDPG
from mjx_dher.networks import Actor, Critic, Networks, fan_in, mlp
from mjx_dher.types import Batch, Sizes
from probes import BATCH, LinearActor

HP = HParams(gamma=0.5, action_l2=0.25)


class LinearCritic(nn.Module):
    """a * observation + b * goal + c * action."""

    @nn.compact
    def __call__(self, observation, goal, action):
        abc = self.param("abc", lambda _: jnp.array([-0.5, 0.25, 0.5]))
        return (abc[0] * observation + abc[1] * goal + abc[2] * action)[..., 0]


NETWORKS = Networks(actor=LinearActor(), critic=LinearCritic())
LEARNER = DDPG(Sizes(1, 1, 1), NETWORKS, NETWORKS)
update = jax.jit(LEARNER.update)


@pytest.fixture
def state():
    return LEARNER.init(jax.random.key(0))


def test_target_value_by_hand(state):
    # Q' of the next states: -0.5 * 0 - 0.25 + 0.5 * tanh(0) = -0.25 and -1 - 1 + 0.5 * tanh(2).
    q = np.array([-0.25, -2 + 0.5 * np.tanh(2)])
    got = ddpg.target_value(NETWORKS, state.target, BATCH, HP)
    np.testing.assert_allclose(got, [-1 + 0.5 * q[0], 0.5 * q[1]], rtol=1e-6)


@pytest.mark.parametrize(("reward", "clipped"), [(-9.0, -2.0), (9.0, 0.0)])
def test_target_value_is_clipped_to_what_returns_can_be(state, reward, clipped):
    batch = BATCH.replace(reward=jnp.full(2, reward))
    np.testing.assert_allclose(ddpg.target_value(NETWORKS, state.target, batch, HP), [clipped, clipped])


def test_losses_by_hand(state):
    # Q of the batch: -0.5 - 0.25 + 0.5 = -0.25 and 0 - 1 - 0.5 = -1.5.
    loss, q_mean = ddpg.critic_loss(NETWORKS, state.params.critic, BATCH, jnp.array([-1.25, -1.0]))
    np.testing.assert_allclose([loss, q_mean], [(1 + 0.25) / 2, -0.875], rtol=1e-6)
    # pi: tanh(1) and 0; Q: -0.75 + tanh(1) / 2 and -1.
    a = np.tanh(1.0)
    loss = ddpg.actor_loss(NETWORKS, state.params.actor, state.params.critic, BATCH, HP)
    np.testing.assert_allclose(loss, -((-0.75 + a / 2) - 1) / 2 + 0.25 * a * a / 2, rtol=1e-6)


def test_update_is_one_adam_step_of_both_from_the_old_parameters(state):
    updated, losses = update(state, BATCH, HP._replace(critic_lr=0.1, actor_lr=0.01))
    target = ddpg.target_value(NETWORKS, state.target, BATCH, HP)
    c_grad = jax.grad(lambda p: ddpg.critic_loss(NETWORKS, p, BATCH, target)[0])(state.params.critic)
    a_grad = jax.grad(lambda p: ddpg.actor_loss(NETWORKS, p, state.params.critic, BATCH, HP))(state.params.actor)
    # Adam's first step moves each parameter by the step size, against the sign of its gradient.
    for new, old, grad, lr in (
        (updated.params.critic, state.params.critic, c_grad, 0.1),
        (updated.params.actor, state.params.actor, a_grad, 0.01),
    ):
        jax.tree.map(lambda n, o, g, lr=lr: np.testing.assert_allclose(n, o - lr * np.sign(g), rtol=1e-4), new, old, grad)
    jax.tree.map(np.testing.assert_array_equal, updated.target, state.target)
    assert updated.num_updates == 1
    assert losses.keys() == {"critic_loss", "actor_loss", "q_mean"}
    np.testing.assert_allclose(losses["q_mean"], -0.875, rtol=1e-6)


def test_summed_gradients_are_averaged_ones_with_a_smaller_adam_eps(state):
    """Of 8 workers: 8 times the gradient, by Adam with eps 1e-3, is the gradient, by Adam with eps 1e-3 / 8."""
    summed = dataclasses.replace(LEARNER, compute_gradients=lambda *args: _times(8.0, *ddpg.compute_gradients(*args)))
    of_sum, of_mean, of_default = state, state, state
    for _ in range(5):
        of_sum, _ = summed.update(of_sum, BATCH, HP._replace(adam_eps=1e-3))
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
    noise = common.Noise(jnp.array([[0.1], [0.1]]), jnp.array([False, True]), jnp.array([[0.9], [-0.9]]))
    obs = {"observation": jnp.array([[0.5], [0.5]]), "desired_goal": jnp.zeros((2, 1))}
    action = LEARNER.explore(state, obs, noise, HP)
    np.testing.assert_allclose(action, [LEARNER.act(state, obs, HP)[0] + 0.1, [-0.9]], rtol=1e-6)
    whole = LEARNER.noise(jax.random.key(0), 3, 2, HP)
    jax.tree.map(np.testing.assert_array_equal, whole, common.exploration_noise(jax.random.key(0), 3, 2, 1, HP))


def make_noise(**hparams):
    return common.exploration_noise(jax.random.key(1), 100, 1000, 2, HParams(**hparams))


def test_exploration_is_a_mixture_of_uniform_and_clipped_gaussian():
    policy = jnp.tile(jnp.array([0.0, 0.9]), (100, 1000, 1))
    noisy = common.add_noise(make_noise(random_eps=0.0, noise_std=0.2), policy)
    assert abs(float(noisy[..., 0].std()) - 0.2) < 0.002
    assert abs(float(noisy[..., 0].mean())) < 0.002
    assert float(noisy.max()) == 1.0
    uniform = common.add_noise(make_noise(random_eps=1.0, noise_std=0.2), policy)
    assert abs(float(uniform.mean())) < 0.005
    assert abs(float(uniform.std()) - 1 / np.sqrt(3)) < 0.005
    mixed = common.add_noise(make_noise(random_eps=0.3, noise_std=0.0), policy)
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
    actor_params = actor.init(jax.random.key(0), obs, goal)
    critic_params = critic.init(jax.random.key(1), obs, goal, action)
    assert actor.apply(actor_params, obs, goal).shape == (7, 4)
    assert critic.apply(critic_params, obs, goal, action).shape == (7,)

    def kernels(params):
        return [params["params"][f"Dense_{i}"]["kernel"].shape for i in range(4)]

    assert kernels(actor_params) == [(28, 256), (256, 256), (256, 256), (256, 4)]
    assert kernels(critic_params) == [(32, 256), (256, 256), (256, 256), (256, 1)]
    assert float(jnp.abs(actor.apply(actor_params, obs + 1e6, goal)).max()) <= 1.0


def test_fan_in_begins_as_pytorch_s_linear_layers_do():
    """Weights and biases are uniform in +-1/sqrt(inputs); of those of `mlp` biases are 0 and weights Xavier's."""
    obs, goal, action = jnp.zeros(25), jnp.zeros(3), jnp.zeros(4)
    for networks, bound_of in ((fan_in, lambda i, o: i**-0.5), (mlp, lambda i, o: (6 / (i + o)) ** 0.5)):
        made = networks(4, (256, 256, 256))
        for params in (made.actor.init(jax.random.key(0), obs, goal), made.critic.init(jax.random.key(1), obs, goal, action)):
            for layer in params["params"].values():
                bound = bound_of(*layer["kernel"].shape)
                assert 0.95 * bound < float(jnp.abs(layer["kernel"]).max()) <= bound
                assert abs(float(layer["kernel"].std()) - bound / np.sqrt(3)) < 0.05 * bound
                bias = float(jnp.abs(layer["bias"]).max())
                assert bias == 0 if networks is mlp else 0 < bias <= bound
    assert isinstance(made.actor, Actor)  # so that kernels and exported policies are what they are


def test_gradients_in_bfloat16_are_those_of_float32_but_for_rounding():
    """8 bits of mantissa: values to half a per cent, and directions of gradients within five degrees."""
    exact, rounded = (mlp(4, (256, 256, 256), dtype) for dtype in ("float32", "bfloat16"))
    params = DDPG(Sizes(25, 3, 4), exact, rounded).init(jax.random.key(0)).params
    observation, following, goal, action = (
        jax.random.normal(jax.random.key(i), (512, size)) for i, size in enumerate((25, 25, 3, 4))
    )
    batch = Batch(observation, following, goal, jnp.tanh(action), -jnp.ones(512))
    hparams = HParams()

    def passes(networks):
        action = networks.actor.apply(params.actor, observation, goal)
        assert action.dtype == networks.critic.apply(params.critic, observation, goal, action).dtype == jnp.float32
        target = ddpg.target_value(networks, params, batch, hparams)
        critic = jax.grad(lambda critic: ddpg.critic_loss(networks, critic, batch, target)[0])(params.critic)
        actor = jax.grad(lambda actor: ddpg.actor_loss(networks, actor, params.critic, batch, hparams))(params.actor)
        return target, ravel_pytree(critic)[0], ravel_pytree(actor)[0]

    (target, *gradients), (near, *others) = passes(exact), passes(rounded)
    assert 0 < float(jnp.abs(target - near).max()) < 0.05
    for ours, other in zip(gradients, others, strict=True):
        assert other.dtype == jnp.float32
        assert float(ours @ other / jnp.linalg.norm(ours) / jnp.linalg.norm(other)) > np.cos(np.radians(5))


def test_critic_learns_a_known_value():
    """A chain whose every step costs 1 and leads to itself: Q = -1 / (1 - gamma), whatever the action."""
    networks = mlp(1, (16,))
    learner = DDPG(Sizes(1, 1, 1), networks, networks)
    state = learner.init(jax.random.key(0))
    hparams = HParams(gamma=0.8, polyak=0.9, critic_lr=0.01)
    ones = jnp.ones((32, 1))

    @jax.jit
    def step(state, key):
        action = jax.random.uniform(key, (32, 1), minval=-1, maxval=1)
        state, losses = learner.update(state, Batch(ones, ones, ones, action, -jnp.ones(32)), hparams)
        return learner.update_target(state, hparams), losses

    state, losses = jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 1500))
    np.testing.assert_allclose(losses["q_mean"][-100:].mean(), -5.0, atol=0.1)
    assert isinstance(state.params, Params)
