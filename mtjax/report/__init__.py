"""Statistics, figures, films, diagnostics and tables of what was learned."""
