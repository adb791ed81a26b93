"""The command line: reading words, flags and files of flags, refusing wrong ones, printing help, and exit codes."""
