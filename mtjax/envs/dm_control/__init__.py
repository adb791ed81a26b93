"""The tasks of the DeepMind Control Suite."""
