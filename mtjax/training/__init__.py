"""Training runs: the host loop, run folders, checkpoints, sweeps, fine-tuning and trained policies."""
