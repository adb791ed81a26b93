"""Statistics, figures, films, diagnostics and tables of a run's results."""
