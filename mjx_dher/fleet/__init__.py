"""Sweeps over many machines, by Ray Core: what a chunk is, how it is trained on a node, how its runs come back."""
