"""Training runs: the host loop, memory, metrics on their way to the user, and fine-tuning."""
