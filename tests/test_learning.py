"""From nothing to a policy, with the settings that a user gets."""

import jax
import numpy as np
import pytest

from mjx_dher import envs, learners, presets, samplers
from mjx_dher.contract import env_spec
from mjx_dher.evaluate import play_policy
from mjx_dher.runs.loop import train


@pytest.mark.slow  # tests/test_trainer.py trains the point mass
def test_reach_is_learned():
    """The preset `cpu`, physics included: at least 0.99 of 300 fresh episodes; an untrained policy reaches hardly any."""
    spec = presets.preset("cpu", "reach", sampler="weighted")
    env = envs.make("reach")
    learner = learners.make(spec.learner, spec.config, env_spec(env), spec.networks)
    for progress in train(env, spec.config, spec.hparams, seed=0, sampler=samplers.make(*spec.sampler_choice), learner=learner):
        trained = progress.state.learner
    before, after = (
        play_policy(env, learner.export(jax.device_get(state), spec.hparams), 300, seed=1)
        for state in (learner.init(jax.random.key(0)), trained)
    )
    np.testing.assert_array_equal(before.reset_success, after.reset_success)
    assert before.success.mean() < 0.2
    assert after.success.mean() >= 0.99
    assert after.reset_success.mean() < 0.1
