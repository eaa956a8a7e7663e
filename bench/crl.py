"""Contrastive RL against HER: `crl` and SAC and TQC with hindsight, at equal steps, updates, networks and normalization.

    python bench/crl.py --out crl --plan        what would be trained
    python bench/crl.py --out crl --minutes 12  trains for 12 minutes, then reports; run it again to resume
    python bench/crl.py --out crl --report      reports the runs that have ended
    python bench/crl.py --out toy --toy --seeds 3   the same on the point mass, on a CPU in minutes

It is bench/bakeoff.py with other arms, and has its options. docs/experiments/crl.md is the plan, written before any run.
"""

import math
import sys
from typing import Any

import bakeoff
from bakeoff_arms import TOY, Arm, Experiment

from mjx_dher import presets
from mjx_dher.config import HParams
from mjx_dher.spec import RunSpec

HER = {"k4": ("future", 4.0), "k8": ("future", 8.0), "final": ("final", 4.0)}  # sampler and k
# JaxGCRL's own numbers: the actor learns from hindsight goals alone, and nothing explores but the policy.
JAXGCRL = {"her_k": math.inf, "actor_lr": 3e-4, "critic_lr": 3e-4, "random_eps": 0.0, "gamma": 0.99}
ARMS = (
    Arm("crl", "crl", {"learner": "crl", "sampler": "geometric"}),
    Arm("crl_hindsight", "crl", {"learner": "crl", "sampler": "geometric"}, {"her_k": math.inf}),
    Arm("crl_uniform", "crl", {"learner": "crl", "sampler": "future"}),
    Arm("crl_jaxgcrl", "crl", {"learner": "crl", "sampler": "geometric"}, JAXGCRL),
    *(Arm(f"sac_{name}", "sac", {"learner": "sac", "sampler": sampler}, {"her_k": k}) for name, (sampler, k) in HER.items()),
    *(Arm(f"tqc_{name}", "tqc", {"learner": "tqc", "sampler": sampler}, {"her_k": k}) for name, (sampler, k) in HER.items()),
)
SHARED: dict[str, Any] = {"cycles_per_epoch": 1, "target_period": 1, "batch_size": 512, "hidden_sizes": (256, 256)}
SIZES: dict[str, dict[str, Any]] = {  # in order of value
    "push": {"num_envs": 256, "updates_per_cycle": 512, "total_steps": 320_000},
    "pick_and_place": {"num_envs": 256, "updates_per_cycle": 512, "total_steps": 512_000},
    "arm_push_easy": {"num_envs": 256, "updates_per_cycle": 1_000, "total_steps": 768_000},
    "slide": {"num_envs": 512, "updates_per_cycle": 1_000, "total_steps": 640_000},
    "arm_push_hard": {"num_envs": 256, "updates_per_cycle": 1_000, "total_steps": 1_152_000},
    "arm_grasp": {"num_envs": 256, "updates_per_cycle": 512, "total_steps": 768_000},
    "block_rotate_z": {"num_envs": 512, "updates_per_cycle": 1_000, "total_steps": 2_048_000},
}
GAMMA = {"push": 0.95, "pick_and_place": 0.95, "slide": 0.97}  # as in the presets; 0.98 for the longer tasks


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm, seed 0. `learner` is the settings' name, `equal`."""
    del learner
    run = presets.preset("gpu", task, networks="layer_norm", priority="eventful", **arm.parts)
    sizes = {**TOY, "target_period": 1} if toy else {**SHARED, **SIZES[task], "replay_size": SIZES[task]["total_steps"]}
    numbers = HParams(gamma=GAMMA.get(task, 0.98), polyak=0.98, action_l2=0.0, entropy_weight=0.1, random_eps=0.1)
    common: dict[str, Any] = {"n_step": 1, "num_critics": 2, "policy_delay": 1, "renewals": 0, "learner_dtype": "float32"}
    common |= {"augmentation": "none"}  # the preset had none when these runs were planned
    return run.replace(hparams=numbers._replace(**arm.numbers), **common, **sizes)


CONTRASTIVE = Experiment(ARMS, ("equal",), tuple(SIZES), spec_of, "crl.csv")

if __name__ == "__main__":
    sys.exit(bakeoff.main(None, CONTRASTIVE, __doc__))
