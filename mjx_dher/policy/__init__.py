"""Trained policies: as NumPy functions, as a learner's state, as files, and bundled with the package.

`Policy` needs only NumPy. Import `policy.load`, `policy.learner_policy` and `policy.bundled` explicitly.
"""

from mjx_dher.policy.numpy_policy import Policy, TrainedPolicy, from_mlp

__all__ = ["Policy", "TrainedPolicy", "from_mlp"]
