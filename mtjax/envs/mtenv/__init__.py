"""MTEnv's own environments."""
