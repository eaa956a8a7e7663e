"""Loads trained policies. Needs only NumPy, unless the run had a custom learner or custom networks."""

from pathlib import Path
from typing import Any

from mjx_dher.policy import Policy, TrainedPolicy, bundled, from_arrays
from mjx_dher.runs.folder import reading, run_folder
from mjx_dher.system import npz
from mjx_dher.system.files import FolderError


def load_policy(run_dir: str | Path, trust: bool = False) -> TrainedPolicy:
    """Loads a bundled policy, or the policy of a run folder. Imports only NumPy, neither JAX nor MuJoCo.

    Policies of custom learners and networks are `learner_policy.LearnerPolicy`s, which need JAX and the run folder.

    Args:
      run_dir: a run folder, a policy.npz under any name, or the name of a bundled policy, such as "push". A run folder or file
        of that name in the current folder takes precedence.
      trust: whether to import a custom learner or networks that the folder names and that you have not trained with here.

    Raises:
      FolderError: there is no such folder or file, the policy is missing or damaged or belongs to another run, or its custom
        learner cannot be imported, is not trusted or does not fit.
    """
    return _load(run_dir, trust, "")


def load_plain(run_dir: str | Path, use: str) -> Policy:
    """Loads a policy of NumPy arrays for the feature `use`, without custom code. Raises ValueError for another policy."""
    policy = _load(run_dir, False, use)
    assert isinstance(policy, Policy)
    return policy


def _load(run_dir: str | Path, trust: bool, use: str) -> TrainedPolicy:
    run_dir = bundled.find(run_dir)
    folder = None if run_dir.is_file() else run_dir
    content, spec = reading.read_run(folder, trust) if folder else ({}, None)
    path = policy_file(folder) if folder else run_dir
    with reading.checked(path, "is damaged or not a policy of this program"):
        arrays: dict[str, Any] = npz.read(path, ratio=reading.POLICY_RATIO)
        if spec and (other := reading.foreign(content, spec, reading.policy_settings(arrays))):
            raise FolderError(f"{path} belongs to a run with other settings: {other}")
        if not {"env_spec", "sizes"} & arrays.keys():
            return from_arrays(arrays)
    if spec is None:
        raise FolderError(f"{path} is the policy of a custom learner or custom networks: pass its run folder instead")
    if use:
        raise ValueError(
            f"{use} needs a policy of linear layers and ReLU for one vector of observations;"
            f" {spec.learner!r} with {spec.networks!r} has another here"
        )
    from mjx_dher.policy.learner_policy import from_arrays as from_state

    with reading.checked(path, "cannot be played"):
        return from_state(arrays, spec)


def policy_file(folder: Path) -> Path:
    """Path of a run's policy. Raises FolderError, with the reason, if there is none."""
    path = folder / run_folder.POLICY_FILE
    if path.is_file():
        return path
    from mjx_dher.runs.folder import results

    if path.exists():
        raise FolderError(f"{path} is not a file")
    ended = "the run has ended with a policy, which was removed or not copied" if results.has_result(folder) else ""
    why = results.failure_of(folder) or ended or "no epoch of the run has ended"
    raise FolderError(f"{path} is missing: {why}")


def check_fits(policy: TrainedPolicy, env: Any) -> None:
    """Raises ValueError unless a policy and an environment agree on the sizes of observations, goals and actions."""
    from mjx_dher.contract import env_spec

    theirs, own = env_spec(env).sizes, policy.sizes
    if theirs != own:
        raise ValueError(
            f"the policy needs observations of {own[0]} and goals of {own[1]} numbers and returns actions of {own[2]}; the"
            f" environment has {theirs[0]}, {theirs[1]} and {theirs[2]}"
        )
