"""Sizes that the kernels share with their callers."""

WIDTH = 256  # units of a hidden layer
ROWS = 128  # rows of a batch that a block of threads takes
THREADS = 384  # threads of a block
BLOCKS = 2  # blocks of a cluster, which share the weights that they read
INPUTS = 64  # columns of a first layer's inputs: observation, goal, zeros and, from ACTION on, the action
ACTION = 56
MAX_ACTION = 4
