"""Arms of bench/bakeoff.py: changes, claims, and the shared settings."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from mjx_dher import presets
from mjx_dher.spec import RunSpec

BASELINE = "future"
TASKS = ("push", "pick_and_place", "slide")
LEARNERS = ("paper", "best")
THRESHOLDS = {"push": 0.9, "pick_and_place": 0.9, "slide": 0.6}
OURS = "nothing: a distance of this library's own, for the paper's open question"


@dataclasses.dataclass(frozen=True)
class Arm:
    """A setting to compare with the baseline."""

    name: str
    # Arms of a group share a program. Arms that evaluate the learner on the whole ring each cycle, and arms that draw four
    # times as many transitions, would slow down the others. Empty: it is no longer in the library, and so only reported.
    group: str
    parts: Mapping[str, str] = dataclasses.field(default_factory=dict)  # fields of RunSpec
    numbers: Mapping[str, float] = dataclasses.field(default_factory=dict)  # fields of HParams
    claim: str = ""
    source: str = ""
    departs: str = ""  # how our form differs from the authors' method
    former: str = ""  # commit with the form of the committed runs, if it has changed since

    @property
    def prioritized(self) -> bool:
        """Whether the arm draws by a priority."""
        return "priority" in self.parts


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Runs and comparisons of bench/bakeoff.py."""

    arms: tuple[Arm, ...]  # the first one is the baseline
    learners: tuple[str, ...]
    tasks: tuple[str, ...]
    spec_of: Callable[[str, str, Arm, bool], Any]  # the RunSpec of a learner, task and arm, seed 0; the last one: as a toy
    table: str  # name of the report's table
    tests: int | None = None  # comparisons of a task that p is corrected over; by default, each learner's arms

    @property
    def runs(self) -> str:
        """File name of the report's runs."""
        return self.table.replace(".csv", "_runs.csv")

    @property
    def baseline(self) -> str:
        """Name of the arm that the others are compared with."""
        return self.arms[0].name

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups of the arms, in order."""
        return tuple(dict.fromkeys(arm.group for arm in self.arms if arm.group))


ARMS = (
    Arm(BASELINE, "plain", {"sampler": "future"}, source="Andrychowicz et al. 2017"),
    Arm(
        "next_future",
        "plain",
        {"sampler": "next_future"},
        claim="sooner on 7 of 8 tasks, higher success on 6 of 8, ten seeds; most under strict tolerances",
        source="Özgür et al. 2025, arXiv 2504.11247, abstract",
        departs="tested at a tolerance of 5 cm",
    ),
    Arm(
        "energy",
        "plain",
        {"priority": "energy"},
        claim='better "performance and sample-efficiency on all four tasks"; a user had 0.65 on PickAndPlace after 100 epochs'
        " on one CPU",
        source="Zhao & Tresp 2018, arXiv 1810.01363, abstract; its repository, issue 2",
        departs="no clip; its authors clip each step at 0.5 J per kg on PickAndPlace (`energy_clipped`), and count rotation on"
        " the hand. They have no Push and no Slide",
    ),
    Arm(
        "max_entropy",
        "plain",
        {"priority": "max_entropy"},
        claim='"promising improvements" in success and samples',
        source="Zhao et al. 2019, arXiv 1905.08786, abstract",
        departs="diagonal covariances, ten rounds of EM, refitted each cycle",
    ),
    Arm(
        "diversity",
        "plain",
        {"priority": "diversity"},
        claim="half of DTGSH, not claimed alone",
        source="Dai et al. 2021, arXiv 2108.07887",
        departs="the authors use it together with `dpp`",
    ),
    Arm(
        "dpp",
        "transitions",
        {"priority": "dpp"},
        claim='with `diversity` "more quickly" and "higher performance" on five tasks; PickAndPlace about 0.94, where HER has'
        " about 0.90",
        source="Dai et al. 2021, arXiv 2108.07887, abstract; the author in TianhongDai/hindsight-experience-replay, issue 18",
        departs="two of eight transitions in place of one k-DPP over the batch",
    ),
    Arm(
        "td_error",
        "errors",
        {"priority": "td_error"},
        claim='"significantly faster" on four tasks',
        source="Luu & Yoo 2021, abstract",
        departs="no weights of importance; one of four candidates in place of all goals of an episode",
    ),
    Arm(
        "curriculum",
        "curriculum",
        {"priority": "curriculum"},
        claim='"improves the state of the art", on Reach and the Hand tasks; users had 0.50 to 0.53 on Slide',
        source="Fang et al. 2019, abstract; its repository, issue 4, and Modular_HER, issue 2",
        departs="the runs chose 8 of 32 by full search, and λ grew to e¹⁰ in half of the authors' updates. Since then 64 of 128"
        " by the best of three, as in the authors' code",
        former="b0586a9",
    ),
    Arm(
        "not_misleading",
        "transitions",
        {"priority": "not_misleading"},
        claim='"vast improvements" on the authors\' own tasks, with a ranking of goals',
        source="Manela & Biess 2021, arXiv 1905.05498, abstract",
        departs="the filter alone, without the ranking of goals",
    ),
    Arm(
        "hgg",
        "plain",
        {"generator": "hgg"},
        claim='"substantial" gain in samples where goals are far off',
        source="Ren et al. 2019, arXiv 1906.04279, abstract",
        departs="soft matching in place of a flow of least cost; no noise on goals. Goals here are near",
    ),
    Arm(
        "archer",
        "plain",
        {},
        {"hindsight_reward": 0.5},
        claim="fewer samples on Reacher and Finger",
        source="Lanka & Wu 2018, arXiv 1809.02070, abstract",
        departs="λ of 0.5, not tuned",
    ),
    Arm("velocity", "plain", {"sampler": "weighted", "metric": "velocity"}, claim=OURS),
    Arm("resting_point", "plain", {"sampler": "weighted", "metric": "resting_point"}, claim=OURS),
    Arm(
        "time_to_goal",
        "",
        {"sampler": "weighted", "metric": "time_to_goal"},
        claim=OURS,
        departs="in the library until commit e1afdfa",
    ),
)


# The fast sweeps of docs/results.md, cut when `future` has learned.
_FAST = {"num_envs": 800, "cycles_per_epoch": 1, "updates_per_cycle": 2000, "learner_dtype": "bfloat16"}
# The preset until 2026-11-27, which the plans name.
_HAND = {"cycles_per_epoch": 1, "updates_per_cycle": 1000, "learner_dtype": "float32", "renewals": 5}
# Changes to the preset's Config by learner and task.
SIZES: dict[tuple[str, str], dict[str, Any]] = {
    ("paper", "push"): {**_FAST, "total_steps": 1_000_000},
    ("paper", "pick_and_place"): {**_FAST, "num_envs": 1600, "total_steps": 2_000_000},
    ("paper", "slide"): {**_FAST, "total_steps": 2_000_000},
    ("best", "push"): {"cycles_per_epoch": 1, "total_steps": 819_200},
    ("best", "pick_and_place"): {"total_steps": 640_000},
    ("best", "slide"): {"cycles_per_epoch": 1, "total_steps": 1_740_800},
    ("best", "hand_reach"): {"total_steps": 1_024_000},
    ("best", "block_rotate_z"): {**_HAND, "total_steps": 1_536_000},
}
TOY: dict[str, Any] = {
    "num_envs": 16,
    "cycles_per_epoch": 5,
    "updates_per_cycle": 20,
    "target_period": 20,
    "batch_size": 64,
    "hidden_sizes": (32, 32),
    "total_steps": 4_000,
    "replay_size": 20_000,
    "eval_episodes": 50,
}


def parts_of(task: str, arm: Arm) -> dict[str, str]:
    """Parts of an arm by field of RunSpec. The metric `resting_point` depends on the task."""
    parts = dict(arm.parts)
    if parts.get("metric") == "resting_point" and task != "slide":
        parts["metric"] = "resting_point_rough"
    return parts


_AS_OF: dict[str, dict[str, Any]] = {  # 2026-11-25, the hand 2026-11-27
    "push": {"augmentation": "none"},
    "pick_and_place": {"num_envs": 512, "replay_size": 4_000_000, "augmentation": "none"},
    "slide": {"policy_delay": 1, "renewals": 0, "learner_dtype": "float32"},
    "block_rotate_z": {"her_k": 4.0},
}


def tuned(task: str, **parts: str) -> RunSpec:
    """The run of the preset `gpu` that these experiments start from, with `parts` replaced.

    For Push, PickAndPlace and Slide it is that preset as of 2026-11-25. On PickAndPlace that is `frugal` with 512 environments
    and a larger ring. On Block Z, k is 4, as until 2026-11-27.
    """
    run = presets.preset("frugal" if task == "pick_and_place" else "gpu", task, **parts)
    return run.replace(**_AS_OF.get(task, {}))


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of an arm, seed 0.

    `paper` is DDPG under the paper's settings, and `best` is `tuned` with `eventful`. In `paper`, priorities choose the whole
    batch, as in their authors' work. In `best` they replace `eventful` for the preset's half of the batch.
    """
    if not toy and (learner, task) not in SIZES:
        raise ValueError(f"learner {learner} has no sizes for task {task}; choose with --learners and --tasks")
    parts = {"priority": "eventful", **parts_of(task, arm)}  # the preset of Slide has `td_error`
    run = presets.preset("paper", task, **parts) if learner == "paper" else tuned(task, **parts)
    # A ring for all transitions: a larger one costs only memory.
    changes = TOY if toy else {**SIZES[learner, task], "replay_size": SIZES[learner, task]["total_steps"]}
    numbers = dict(arm.numbers)
    if arm.prioritized and learner == "paper":
        numbers["priority_fraction"] = 1.0
    return run.replace(**changes, **numbers)


BAKEOFF = Experiment(ARMS, LEARNERS, TASKS, spec_of, "bakeoff.csv")
