"""Sizes that the kernels and their callers share."""

WIDTH = 256  # units of a hidden layer
ROWS = 128  # of a batch, a block of threads
THREADS = 384  # of a block
BLOCKS = 2  # that share what they read
INPUTS = 64  # columns of a first layer's inputs: observation, goal, zeros and, from ACTION on, the action
ACTION = 56
MAX_ACTION = 4
