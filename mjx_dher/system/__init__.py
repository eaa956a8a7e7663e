"""The machine that runs the program: memory, files, caches, libraries' internals. Nothing here knows of learning."""
