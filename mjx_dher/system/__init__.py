"""The machine that runs the program: memory, files, caches and internals of libraries. Independent of learning."""
