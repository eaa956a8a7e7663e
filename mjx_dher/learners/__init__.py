"""Learners: each is one file, over shared pieces."""
