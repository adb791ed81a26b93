"""What a user calls to train: the command line with its flags, help, sweeps and exit codes, and ``mtjax.train``."""
