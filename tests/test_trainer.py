import dataclasses
import functools
import itertools

import configs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import SMALL
from conftest import refuses

from mjx_dher import HParams, learners, make_train, relabel, replay, samplers, trainer
from mjx_dher.contract import env_spec
from mjx_dher.rollout import rollout
from mjx_dher.runs import loop
from mjx_dher.system import machine
from probes import Explodes, Least, PointMass, Walk

ENV = PointMass()
DTYPES = ("float32", "bfloat16")
LEARNS = dataclasses.replace(configs.LEARNS, total_steps=16_000)  # 20 epochs


def made(env=ENV, config=SMALL):
    """A training loop whose `init` is compiled."""
    program = make_train(env, config)
    return program._replace(init=jax.jit(program.init))


@pytest.fixture(scope="module")
def program():
    """The training loop of SMALL, and its epoch, compiled once."""
    program = made()
    return program, jax.jit(program.epoch)


def test_rollout_keeps_every_observation():
    actions = jax.random.uniform(jax.random.key(1), (10, 3, 2), minval=-1, maxval=1)
    play = jax.jit(lambda key, actions: rollout(ENV, lambda action, obs: action, key, 3, actions))
    episodes, outcome = play(jax.random.key(0), actions)
    np.testing.assert_array_equal(episodes.action, jnp.moveaxis(actions, 0, 1))
    assert episodes.observation.shape == (3, 11, 2)
    assert episodes.action.shape == (3, 10, 2)
    np.testing.assert_allclose(episodes.achieved_goal[:, 1:], episodes.achieved_goal[:, :-1] + 0.1 * episodes.action, atol=1e-6)
    distance = jnp.linalg.norm(episodes.achieved_goal - episodes.desired_goal[:, None], axis=-1)
    np.testing.assert_array_equal(outcome.success, distance[:, -1] <= 0.1)
    np.testing.assert_array_equal(outcome.reset_success, distance[:, 0] <= 0.1)
    np.testing.assert_array_equal(outcome.ret, -jnp.sum(distance[:, 1:] > 0.1, axis=1))


def test_an_environment_s_check_is_made_before_the_first_epoch_and_after_each_and_ends_the_run():
    class Checked(PointMass):
        checks = 0

        def check(self):
            self.checks += 1
            if self.checks == 3:
                raise ValueError("contacts were lost")

    env = Checked()
    config = dataclasses.replace(SMALL, cycles_per_epoch=1, total_steps=80)
    run = loop.train(env, config, HParams(), seed=0, learner=Least())
    assert next(run).epoch == 1
    assert env.checks == 2
    with pytest.raises(ValueError, match="contacts were lost"):
        next(run)


@pytest.mark.parametrize(("at_once", "draws"), [(32 * 2, 2), (32 * 4, 1), (1, 2)])
def test_batches_are_drawn_up_to_so_many_at_once(program, monkeypatch, at_once, draws):
    """A cycle of 4 updates of 32 with a target update every 2: never less at once than between two target updates."""
    shapes = []

    def draw_batches(ring, key, shape, *args):
        shapes.append(shape)
        return relabel.draw_batches(ring, key, shape, *args)

    monkeypatch.setattr(trainer, "draw_batches", draw_batches)
    monkeypatch.setattr(trainer, "MAX_TRANSITIONS_PER_DRAW", at_once)
    jaxpr, (state, _) = jax.make_jaxpr(lambda state: program[0].epoch(state), return_shape=True)(
        loop.state_template(program[0])
    )
    assert set(shapes) == {(2 // draws, 2, 32)}
    assert f"length={draws}" in str(jaxpr)
    assert state.learner.num_updates.shape == ()


def test_an_epoch_counts_what_it_does(program):
    program, epoch = program
    state, metrics = epoch(program.init(jax.random.key(0), HParams()))
    assert state.env_steps == 4 * 3 * 10
    assert state.learner.num_updates == 3 * 4
    assert state.replay.size == 12
    assert state.learner.observation_norm.count == 4 * 3 * 11
    assert state.learner.goal_norm.count == 4 * 3 * 10
    assert set(metrics) == {
        *("success_rate", "reset_success_rate", "return_mean", "train_success_rate", "train_return_mean", "priority_mean"),
        *("relabelled_share", "relabel_distance", "critic_loss", "actor_loss", "q_mean", "actor_norm", "critic_norm"),
        *("discarded_episodes", "bad_rewards", "bad_success", "no_goal_share"),
    }
    squares = sum(np.square(x).sum() for x in jax.tree.leaves(jax.device_get(state.learner.params.actor)))
    assert float(metrics["actor_norm"]) == pytest.approx(float(squares) ** 0.5, rel=1e-5)
    # Of 120 transitions, each with probability 0.8: 0.8 within four standard deviations.
    assert abs(metrics["relabelled_share"] - 0.8) < 4 * (0.16 / 120) ** 0.5
    assert metrics["discarded_episodes"] == 0
    assert all(value.shape == () and jnp.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize("value", [jnp.nan, pytest.param(jnp.inf, marks=pytest.mark.slow), None])
def test_episodes_that_blow_up_leave_no_trace(value):
    """A quarter of all starts ends in NaN, Inf or a `failed` state: counted exactly, in no ring, in no normalizer."""
    env = Explodes(value)
    program = made(env, dataclasses.replace(SMALL, num_envs=8, cycles_per_epoch=1, replay_size=1000))
    first = program.init(jax.random.key(0), HParams())
    state, metrics = jax.jit(program.epoch)(first)
    kept = int(state.replay.size)
    assert 0 < kept < 8
    assert metrics["discarded_episodes"] == 8 - kept
    goals = np.asarray(state.replay.episodes.achieved_goal[:kept])
    assert goals[:, 0, 0].max() <= Explodes.EDGE
    assert state.learner.observation_norm.count == kept * 11
    np.testing.assert_allclose(state.learner.observation_norm.mean, goals.reshape(-1, 2).mean(0), rtol=1e-5)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.learner, metrics)))


def test_an_episode_with_a_failure_that_the_environment_forgets_is_discarded():
    class Forgets(Explodes):
        def step(self, state, action):
            return super().step(dataclasses.replace(state, failed=jnp.zeros((), bool)), action)

    play = jax.jit(lambda key: rollout(Forgets(None), lambda _, obs: jnp.zeros((16, 2)), key, 16))
    episodes, outcome = play(jax.random.key(0))
    breaks = episodes.achieved_goal[:, 0, 0] > Explodes.EDGE
    assert 0 < breaks.sum() < 16
    np.testing.assert_array_equal(outcome.valid, ~breaks)


def test_without_any_valid_episode_nothing_is_learned():
    program = made(Explodes(jnp.nan, edge=-1.0))
    first = program.init(jax.random.key(0), HParams())
    state, metrics = jax.jit(program.epoch)(first)
    assert metrics["discarded_episodes"] == 4 * 3
    assert metrics["success_rate"] == 0
    assert np.isnan([metrics["return_mean"], metrics["train_return_mean"]]).all()
    jax.tree.map(np.testing.assert_array_equal, state.learner, first.learner)
    assert not replay.can_sample(state.replay)


def test_targets_follow_every_target_period(program):
    """With polyak 0 a soft update copies, so after a cycle targets equal the networks; with 1 they never move."""
    program, epoch = program
    for polyak, moves in ((0.0, True), (1.0, False)):
        first = program.init(jax.random.key(0), HParams(polyak=polyak))
        learner = epoch(first)[0].learner
        same = learner.params if moves else first.learner.target
        jax.tree.map(np.testing.assert_array_equal, learner.target, same)


def test_seeds_under_vmap_are_what_they_are_alone_and_differ(program):
    """Two seeds in one program against two runs of one.

    What is drawn is the same to the bit; sums inside the networks are ordered otherwise once a batch axis is there, and Adam
    turns a last-bit difference of a gradient near zero into one of up to its step size. After 24 updates at 1e-3 the
    parameters stay within 1e-3 of each other, a hundredth of what learning moved them.
    """
    program, epoch = program
    epochs = jax.jit(jax.vmap(program.epoch))
    seeds = [0, 1]
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    hparams = jax.tree.map(lambda x: jnp.full(2, x), HParams())
    together = jax.jit(jax.vmap(program.init))(keys, hparams)
    for _ in range(2):
        together, metrics = epochs(together)
    alone, row_of = [], jax.jit(lambda tree, row: jax.tree.map(lambda x: x[row], tree))
    for row, seed in enumerate(seeds):
        state = program.init(jax.random.key(seed), HParams())
        for _ in range(2):
            state, own_metrics = epoch(state)
        alone.append(state)
        mine = row_of(together, row)
        np.testing.assert_array_equal(jax.random.key_data(mine.key), jax.random.key_data(state.key))
        np.testing.assert_array_equal(mine.replay.episodes.desired_goal, state.replay.episodes.desired_goal)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-3), mine.learner, state.learner)
        np.testing.assert_allclose(metrics["return_mean"][row], own_metrics["return_mean"], atol=0.3)
    assert not np.array_equal(alone[0].replay.episodes.action, alone[1].replay.episodes.action)
    leaves = zip(jax.tree.leaves(alone[0].learner.params), jax.tree.leaves(alone[1].learner.params))
    assert max(np.abs(np.asarray(a) - b).max() for a, b in leaves) > 0.05


def test_hparams_are_traced_one_compilation_serves_all(program):
    program, epoch = program
    for hparams in (HParams(), HParams(gamma=0.9, her_k=2, actor_lr=3e-4)):
        epoch(jax.jit(program.init)(jax.random.key(0), hparams))
    assert epoch._cache_size() == 1


@pytest.fixture(scope="module")
def learn():
    """Trains the point mass for so many epochs, of 800 steps, and yields each Progress; compiled once for each dtype."""

    @functools.cache
    def compiled(dtype):
        config = dataclasses.replace(LEARNS, learner_dtype=dtype)
        learner = learners.make("ddpg", config, env_spec(ENV))
        train = make_train(ENV, config, sampler=samplers.make("weighted"), learner=learner)
        return config, loop.compile_program(train, jax.random.key(0), HParams())

    def learn(hparams, epochs, dtype="float32"):
        config, program = compiled(dtype)
        start = loop.Start(program.init(jax.random.key(0), hparams))
        return itertools.islice(loop.run(ENV, config, program, start), epochs)

    return learn


@pytest.mark.parametrize("dtype", [DTYPES[0], pytest.param(DTYPES[1], marks=pytest.mark.slow)])
def test_training_solves_the_point_mass(dtype, learn):
    records = list(learn(HParams(polyak=0.98, gamma=0.9), 10, dtype))
    curve = [record.metrics["success_rate"] for record in records]
    assert [record.epoch for record in records] == list(range(1, 11))
    assert records[-1].env_steps == 8_000
    assert curve[-1] >= 0.95
    assert records[-1].metrics["reset_success_rate"] < 0.2  # it was not solved from the start
    # The shortest way takes up to distance / 0.1 steps of -1; a policy that has learned comes close to it.
    assert records[-1].metrics["return_mean"] > -4.5


def test_a_frozen_learner_stays_near_chance(learn):
    """The probe can fail: a frozen learner stays at the level of chance."""
    records = list(learn(HParams(actor_lr=0.0, critic_lr=0.0), 10))
    assert records[-1].metrics["success_rate"] < 0.5


@pytest.mark.slow
def test_bfloat16_is_for_learning_alone():
    """First networks, parameters, normalizers and the policy that plays are those of float32."""
    program, other = (make_train(ENV, dataclasses.replace(SMALL, learner_dtype=dtype)) for dtype in DTYPES)
    first = other.init(jax.random.key(0), HParams())
    jax.tree.map(np.testing.assert_array_equal, first.learner, program.init(jax.random.key(0), HParams()).learner)
    learned = jax.jit(other.epoch)(first)[0].learner
    assert {leaf.dtype for leaf in jax.tree.leaves(learned)} == {jnp.dtype("float32"), jnp.dtype("int32")}
    moved = jax.tree.map(lambda new, old: float(jnp.abs(new - old).max()), learned.params, first.learner.params)
    assert min(jax.tree.leaves(moved)) > 0.001
    assert ["bf16" in str(jax.make_jaxpr(p.epoch)(first)) for p in (program, other)] == [False, True]
    play = lambda state, key: other.evaluate(state, key, 8)  # noqa: E731
    assert "bf16" not in str(jax.make_jaxpr(play)(first, jax.random.key(1)))


def test_the_same_seed_gives_the_same_run(program):
    program, epoch = program

    def run(seed):
        state, rows = program.init(jax.random.key(seed), HParams()), []
        for _ in range(2):
            state, metrics = epoch(state)
            rows.append({name: float(value) for name, value in metrics.items()})
        return rows

    runs = [run(seed) for seed in (3, 3, 4)]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


@pytest.mark.slow
def test_replay_memory_is_what_the_arrays_need():
    """The compiled epoch owns its state in place: beside it there is little, and no second ring."""
    program = make_train(ENV, dataclasses.replace(SMALL, replay_size=1_000_000))
    shapes = jax.eval_shape(program.init, jax.random.key(0), HParams())
    memory = jax.jit(program.epoch, donate_argnums=0).lower(shapes).compile().memory_analysis()
    assert program.replay_bytes == sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes.replay.episodes))
    total = memory.argument_size_in_bytes + memory.temp_size_in_bytes
    total += memory.output_size_in_bytes - memory.alias_size_in_bytes
    assert total <= 1.05 * program.replay_bytes


def test_a_ring_that_cannot_fit_is_refused_before_it_is_allocated():
    huge = dataclasses.replace(SMALL, replay_size=10**10)
    with refuses("replay_size", 10**10, "GB"):
        next(iter(loop.train(ENV, huge)))


def test_networks_that_cannot_fit_are_refused_before_anything_is_compiled(monkeypatch):
    monkeypatch.setattr(loop, "compile_program", lambda *args: pytest.fail("compiled"))
    huge = dataclasses.replace(SMALL, hidden_sizes=(65_536, 65_536, 65_536))
    with refuses("hidden_sizes", 65536, "GB"):
        next(iter(loop.train(ENV, huge)))


def test_what_the_compiler_counts_as_too_much_is_refused_before_training(monkeypatch):
    """Against 300 MB of memory: the ring, 260 MB, and the networks fit, the program does not."""
    monkeypatch.setattr(machine, "available_bytes", lambda: 3 * 10**8)
    large = dataclasses.replace(SMALL, cycles_per_epoch=1, replay_size=10**6, total_steps=40, batch_size=10**6)
    with refuses("300.0 MB", "batch_size", 10**6):
        next(iter(loop.train(ENV, large)))


def test_observations_that_are_no_vector_are_refused():
    class Pixels(PointMass):
        def reset(self, key):
            state = super().reset(key)
            return state.replace(obs={**state.obs, "observation": jnp.zeros((2, 2))})

    with refuses("observation", "encoder"):
        make_train(Pixels(), SMALL)


def test_train_refuses_before_it_compiles(monkeypatch):
    called = []
    monkeypatch.setattr(loop, "compile_program", lambda *args: called.append(args))
    with refuses("gamma"):
        next(iter(loop.train(ENV, SMALL, HParams(gamma=1.0))))
    assert not called


def test_step_sizes_fall_linearly_to_their_end():
    hparams = HParams(actor_lr=0.2, critic_lr=0.4, lr_end=0.25)
    for progress, left in ((0.0, 1.0), (0.5, 0.625), (1.0, 0.25), (2.0, 0.25)):
        now = trainer.anneal(hparams, progress)
        np.testing.assert_allclose((now.actor_lr, now.critic_lr), (0.2 * left, 0.4 * left), rtol=1e-6)
        assert now.gamma == hparams.gamma


def test_a_run_ends_with_the_step_sizes_at_their_end(learn):
    """With lr_end 0 the last of many small epochs hardly moves the actor, the first one does."""
    params = [jax.device_get(record.state.learner.params.actor) for record in learn(HParams(lr_end=0.0), 20)]
    first, last = (
        max(float(np.abs(a - b).max()) for a, b in zip(jax.tree.leaves(params[i]), jax.tree.leaves(params[i + 1])))
        for i in (0, -2)
    )
    assert last < 0.2 * first


def test_normalizers_leave_out_what_follows_an_early_end():
    env = Walk()
    train = made(env, dataclasses.replace(SMALL, num_envs=16, replay_size=100_000))
    state, _ = jax.jit(train.epoch)(train.init(jax.random.key(0), HParams()))
    episodes, number = jax.device_get(state.replay.episodes), int(state.replay.size)
    assert set(episodes.length[:number].tolist()) > {env.episode_length}
    seen = np.concatenate([episodes.observation[i, : episodes.length[i] + 1] for i in range(number)])
    moments = state.learner.observation_norm
    assert int(moments.count) == len(seen)
    np.testing.assert_allclose(moments.mean, seen.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(moments.var, seen.var(axis=0), rtol=1e-4)
