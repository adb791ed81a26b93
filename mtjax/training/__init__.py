"""Runs: the host's loop, their folders and checkpoints, sweeps, fine-tuning and trained policies."""
