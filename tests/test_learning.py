"""From nothing to a policy, with the settings that a user gets."""

import dataclasses

import jax
import numpy as np

from mjx_dher import cli, envs, policy, presets, trainer


def test_reach_is_learned():
    """The preset `cpu`, physics included: at least 0.99 of 300 fresh episodes; an untrained policy reaches hardly any."""
    settings, hparams = presets.preset("cpu", "reach")
    env = envs.make("reach")
    learner = None
    for progress in trainer.train(env, dataclasses.replace(settings, sampler="weighted"), hparams, seed=0):
        learner = progress.state.learner
    untrained = trainer.make_train(env, settings).init(jax.random.key(0), hparams).learner
    before = cli.play(env, policy.from_learner(untrained, hparams), 300, seed=1)
    after = cli.play(env, policy.from_learner(learner, hparams), 300, seed=1)
    np.testing.assert_array_equal(before.reset_success, after.reset_success)
    assert before.success.mean() < 0.2
    assert after.success.mean() >= 0.99
    assert after.reset_success.mean() < 0.1
