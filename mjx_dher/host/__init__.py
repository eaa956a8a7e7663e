"""The machine that runs the program: memory, files, caches, Warp's set-up. Knows nothing of learning."""
