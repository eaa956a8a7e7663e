"""Failures and warnings, from an epoch's metrics."""

from __future__ import annotations

from collections.abc import Mapping

from mjx_dher.config import Config


def failure(metrics: Mapping[str, float], config: Config, finite: bool) -> str | None:
    """Reason why a run ends as failed after an epoch, or None.

    Args:
      metrics: of the epoch, by the names of `trainer.make_train`.
      config: sizes.
      finite: whether all numbers of the learner are finite.
    """
    if not finite:
        return "the networks or normalizers hold numbers that are not finite (smaller actor_lr and critic_lr may help)"
    episodes = config.num_envs * config.cycles_per_epoch
    if metrics["discarded_episodes"] >= episodes:
        return (
            f"all {episodes} episodes were discarded, so nothing can be learned: the environment says `failed`, or an"
            " observation, a goal, an action or a reward is not finite"
        )
    if metrics["bad_success"] > 0:
        return f"success must be 0 or 1; in {metrics['bad_success']:.3g} of the episodes it is not"
    if metrics["no_goal_share"] >= 1:
        return "the sampler offers no hindsight goal for any transition: its weights are all 0, NaN or infinite"
    return None


def warnings(metrics: Mapping[str, float], config: Config) -> dict[str, str]:
    """Warnings about an epoch with these metrics: a sentence for each metric at fault."""
    episodes = config.num_envs * config.cycles_per_epoch
    sentences = {
        "discarded_episodes": f"{metrics['discarded_episodes']:.0f} of {episodes} episodes were discarded: the environment says"
        " `failed`, or a number in them is not finite",
        "bad_rewards": f"{metrics['bad_rewards']:.3g} of the rewards lie outside the environment's reward range, whose returns"
        " bound the learner's targets",
        "no_goal_share": f"for {metrics['no_goal_share']:.3g} of the transitions to be relabelled the sampler offers no goal;"
        " these keep their own",
    }
    return {name: text for name, text in sentences.items() if metrics[name] > 0}
