"""Learners and networks of one's own: what is taken, what is refused, how they train, and their policies as files."""

import dataclasses
import sys
import types

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import LEARNS as SMALL
from conftest import refuses, save_policy

import mjx_dher
from mjx_dher import HParams, RunSpec, learners, make_train, networks
from mjx_dher.learners import common, ddpg
from mjx_dher.networks import Actor, Critic, Networks
from mjx_dher.policy import Policy, learner_policy
from mjx_dher.runs.folder import run_folder
from point_mass import PointMass
from probes import spec_of

TASK = spec_of(2, 2, 2)
HP = HParams(gamma=0.9, polyak=0.9, action_l2=0.1)
METHODS = ("init", "act", "explore", "update", "noise", "update_normalizers", "update_target", "summary", "export")


class Straight(nn.Module):
    """An actor that goes straight for the goal, as far as it has learned to: one number."""

    @nn.compact
    def __call__(self, observation, goal):
        gain = self.param("gain", nn.initializers.zeros, ())
        return jnp.tanh(gain * (goal - observation))


class Distance(nn.Module):
    """A critic that looks at where an action leads, relative to the goal, through one hidden layer."""

    size: int
    dtype: str

    @nn.compact
    def __call__(self, observation, goal, action):
        inputs = jnp.concatenate([goal - observation, action], axis=-1)
        hidden = nn.relu(nn.Dense(self.size, dtype=jnp.dtype(self.dtype))(inputs))
        return nn.Dense(1, dtype=jnp.float32)(hidden)[..., 0]


def own_networks(action_size, hidden_sizes, dtype):
    return Networks(Straight(), Distance(hidden_sizes[0], dtype))


def own_learner(config, spec, make_networks):
    """DDPG with a step size of its own and a metric more."""

    @dataclasses.dataclass(frozen=True)
    class Quick(ddpg.DDPG):
        def update(self, state, batch, hparams):
            state, losses = super().update(state, batch, hparams._replace(actor_lr=0.01))
            return state, losses | {"reward_mean": jnp.mean(batch.reward)}

    both = make_networks(spec.action_size, config.hidden_sizes, "float32")
    return Quick(spec, both, both)


@pytest.fixture
def mine(monkeypatch):
    """A module of the user's."""
    module = types.ModuleType("mine")
    module.networks, module.learner, module.two = own_networks, own_learner, 2
    monkeypatch.setitem(sys.modules, "mine", module)
    return module


def test_the_default_is_ddpg_with_the_paper_s_networks():
    learner = learners.make("ddpg", dataclasses.replace(SMALL, learner_dtype="bfloat16"), TASK)
    assert isinstance(learner, ddpg.DDPG)
    assert learner.spec == TASK
    assert learner.networks == networks.mlp(2, (32, 32), "float32") == Networks(Actor(2, (32, 32)), Critic((32, 32)))
    assert learner.learning == networks.mlp(2, (32, 32), "bfloat16")


@pytest.mark.parametrize("name", ["ddpg", "tqc"])
def test_values_are_of_the_learner_s_type_and_actions_are_not(name):
    learner = learners.make(name, dataclasses.replace(SMALL, learner_dtype="bfloat16"), TASK)
    state, goal = jax.jit(learner.init)(jax.random.key(0)), jnp.ones((3, 2))
    obs = {"observation": jnp.ones((3, 2)), "achieved_goal": goal, "desired_goal": goal}
    programs = jax.make_jaxpr(learner.value)(state, obs, goal, HP), jax.make_jaxpr(learner.act)(state, obs, HP)
    assert ["bf16" in str(program) for program in programs] == [True, False]
    assert learner.value(state, obs, goal, HP).dtype == jnp.float32


def test_a_learner_is_a_function_or_a_place(mine):
    for name in ("mine:learner", own_learner):
        learner = learners.make(name, SMALL, TASK, "mine:networks")
        assert type(learner).__name__ == "Quick"
        assert learner.networks == own_networks(2, (32, 32), "float32")


def test_networks_are_a_function_or_a_place(mine):
    assert networks.make("mlp") is networks.mlp
    assert networks.make("mine:networks") is networks.make(own_networks) is own_networks
    learner = learners.make("ddpg", dataclasses.replace(SMALL, learner_dtype="bfloat16"), TASK, "mine:networks")
    assert learner.networks.critic == Distance(32, "float32")
    assert learner.learning.critic == Distance(32, "bfloat16")


@pytest.mark.parametrize(
    ("field", "make", "parameters"),
    [
        ("learner", lambda name: learners.make(name, SMALL, TASK), "(config, spec, networks)"),
        ("networks", networks.make, "(action_size, hidden_sizes, dtype)"),
        ("networks", lambda name: learners.make("ddpg", SMALL, TASK, name), "(action_size, hidden_sizes, dtype)"),
    ],
)
def test_names_and_functions_that_cannot_be_used_are_refused(mine, field, make, parameters):
    known = {"learner": "ddpg", "networks": "mlp"}[field]
    for name, parts in {
        known[:-1]: [known[:-1], known, "module:attribute"],
        f"mine:{field}s": [f"mine:{field}s", field],
        "mine:two": [parameters, 2],
        "no_such_module:x": ["no_such_module"],
    }.items():
        with refuses(field, *parts):
            make(name)
    with refuses(field, parameters):
        make(lambda one: one)


def test_a_learner_without_methods_is_rejected_by_their_names(mine):
    with refuses(*METHODS):
        learners.make(lambda config, sizes, networks: object(), SMALL, TASK)
    methods = {name: (lambda *args: None) for name in METHODS} | {"act": 3}
    mine.part = lambda config, sizes, networks: types.SimpleNamespace(**methods)
    for name in ("mine:part", mine.part):
        with refuses("act", repr(name)):
            learners.make(name, SMALL, TASK)


class Walk(learners.Learner):
    """A learner of four methods, whose state counts updates; a random walk explores."""

    def init(self, key):
        return jnp.zeros(())

    def act(self, state, obs, hparams):
        return jnp.zeros_like(obs["desired_goal"])

    def explore(self, state, obs, noise, hparams):
        return jax.vmap(lambda key: jax.random.uniform(key, (2,), minval=-1.0))(noise)

    def update(self, state, batch, hparams):
        return state + 1, {}


def test_four_methods_make_a_learner():
    learner = learners.make(lambda config, sizes, networks: Walk(), SMALL, TASK)
    program = make_train(PointMass(), SMALL, learner=learner)
    state, metrics = jax.jit(program.epoch)(jax.jit(program.init)(jax.random.key(0), HP))
    assert float(state.learner) == SMALL.cycles_per_epoch * SMALL.updates_per_cycle
    actions = np.asarray(state.replay.episodes.action[: 5 * 16])
    assert abs(actions.std() - 1 / np.sqrt(3)) < 0.02
    assert len(np.unique(actions)) > 0.99 * actions.size  # each environment and step has its own key
    assert metrics["success_rate"] < 0.5
    assert learner.export(state.learner, HP) is None


def test_a_delay_needs_updates_without_the_actor():
    methods = {name: (lambda *args: None) for name in METHODS}
    for delay in (3, 0, 2.0):
        made = types.SimpleNamespace(**methods, policy_delay=delay)
        with refuses("policy_delay"):
            learners.make(lambda config, sizes, networks, made=made: made, SMALL, TASK)


class Wide(nn.Module):
    """Gives one number too many."""

    size: int

    @nn.compact
    def __call__(self, observation, goal, *action):
        return nn.Dense(self.size + 1)(jnp.concatenate([observation, goal, *action], axis=-1))


@pytest.mark.parametrize(
    ("made", "parts"),
    [
        (Networks(Wide(2), Critic((8,))), ["actor", "[2, 2]", "(2, 3)"]),
        (Networks(Actor(3, (8,)), Critic((8,))), ["actor", "[2, 2]", "(2, 3)"]),
        (Networks(Actor(2, (8,)), Wide(0)), ["critic", "[2]", "(2, 1)"]),
    ],
)
def test_networks_of_the_wrong_output_shape_are_refused(made, parts):
    with pytest.raises(ValueError, match="networks") as error:
        learners.make("ddpg", SMALL, TASK, lambda action_size, hidden_sizes, dtype: made)
    assert all(part in str(error.value).replace("float32[2,3]", "(2, 3)") for part in parts), error.value


@pytest.fixture(scope="module")
def trained():
    """(the learner with own actor and critic, its states before and after training, metrics of each epoch)."""
    learner = learners.make(own_learner, SMALL, TASK, own_networks)
    program = make_train(PointMass(), SMALL, learner=learner)
    assert program.learner is learner
    state = jax.jit(program.init)(jax.random.key(0), HP)
    before, epoch, metrics = state.learner, jax.jit(program.epoch), []
    for _ in range(5):
        state, found = epoch(state)
        metrics.append(jax.device_get(found))
    return learner, before, state.learner, metrics


def test_an_actor_and_a_critic_of_one_s_own_learn_the_point_mass(trained):
    _, before, after, metrics = trained
    assert float(before.params.actor["params"]["gain"]) == 0
    assert float(after.params.actor["params"]["gain"]) > 0.5
    assert metrics[-1]["success_rate"] > 0.95
    assert metrics[0]["reset_success_rate"] < 0.3


def test_what_the_learner_reports_is_logged(trained):
    *_, metrics = trained
    assert metrics[0].keys() >= {"reward_mean", "critic_loss", "actor_norm", "success_rate", "priority_mean"}
    assert all(-1 < found["reward_mean"] < 0 for found in metrics)
    np.testing.assert_allclose(metrics[-1]["actor_norm"], trained[2].params.actor["params"]["gain"], rtol=1e-6)


def test_networks_of_one_s_own_are_not_exported_and_the_default_ones_are(trained):
    learner, _, state, _ = trained
    assert learner.export(state, HP) is None
    default = learners.make("ddpg", SMALL, TASK)
    assert isinstance(default.export(default.init(jax.random.key(0)), HP), Policy)


OBS = {
    "observation": np.random.default_rng(0).normal(size=(64, 2)).astype(np.float32),
    "desired_goal": np.random.default_rng(1).normal(size=(64, 2)).astype(np.float32),
    "achieved_goal": np.zeros((64, 2), np.float32),
}
SPEC = RunSpec(env="point_mass:PointMass", learner="mine:learner", networks="mine:networks", config=SMALL, hparams=HP)


@pytest.fixture
def folder(tmp_path, trained, mine):
    learner, _, state, _ = trained
    run_folder.write_config(tmp_path / "run", SPEC, "none", {})
    save_policy(tmp_path / "run", learner_policy.LearnerPolicy(learner, state, HP, TASK))
    return tmp_path / "run"


def test_a_stored_policy_acts_as_the_learner_does(folder, trained):
    learner, _, state, _ = trained
    policy = mjx_dher.load_policy(folder)
    actions = policy(OBS)
    assert isinstance(actions, np.ndarray)
    assert actions.shape == (64, 2)
    assert actions.std() > 0.1
    np.testing.assert_array_equal(actions, learner.act(state, OBS, HP))
    np.testing.assert_allclose(policy({name: value[7] for name, value in OBS.items()}), actions[7], rtol=1e-5)
    traced = jax.jit(lambda obs: policy.forward(obs["observation"], obs["desired_goal"], jnp))(OBS)
    np.testing.assert_allclose(actions, traced, rtol=1e-5)
    assert {path.name for path in folder.iterdir()} == {"config.json", "policy.npz"}


def test_its_numbers_come_back_to_the_bit(folder, trained):
    policy = mjx_dher.load_policy(folder)
    jax.tree.map(np.testing.assert_array_equal, policy.state, trained[2])
    assert (policy.spec, policy.hparams) == (TASK, HP)
    assert isinstance(policy.state.params, common.Params)


class Keyed(learners.Learner):
    """Its state has a random key, and numbers of a type that NumPy lacks."""

    def __init__(self, config, spec, networks):
        pass

    def init(self, key):
        return {"gain": jnp.full((), 0.3, jnp.bfloat16), "key": key}

    def act(self, state, obs, hparams):
        return jnp.tanh(state["gain"] * (obs["desired_goal"] - obs["observation"]))


def test_keys_and_bfloat16_come_back_to_the_bit(tmp_path):
    run = RunSpec(env="point_mass:PointMass", learner="test_learners:Keyed", config=SMALL)
    run_folder.write_config(tmp_path, run, "none", {})
    learner = Keyed(SMALL, TASK, None)
    state = jax.device_get(learner.init(jax.random.key(7)))
    save_policy(tmp_path, learner_policy.LearnerPolicy(learner, state, HP, TASK))
    policy = mjx_dher.load_policy(tmp_path, trust=True)
    assert policy.state["gain"].dtype == jnp.bfloat16
    assert policy.state["gain"] == state["gain"]
    assert policy.state["key"] == state["key"]
    np.testing.assert_array_equal(policy(OBS), learner.act(state, OBS, HP))


@pytest.mark.parametrize("changes", [{"networks": "mlp"}, {"config": dataclasses.replace(SMALL, hidden_sizes=(16,))}])
def test_a_stored_policy_of_other_networks_is_refused(folder, changes, mine):
    policy = mjx_dher.load_policy(folder)
    run_folder.write_config(folder, dataclasses.replace(SPEC, **changes), "none", {})
    save_policy(folder, policy)
    with refuses("policy.npz", changes.get("networks", "mine:networks"), "mine:learner"):
        mjx_dher.load_policy(folder)


def test_a_stored_policy_needs_its_module(folder, monkeypatch):
    monkeypatch.delitem(sys.modules, "mine")
    with refuses("mine"):
        mjx_dher.load_policy(folder)
