"""Physics engines with one interface."""
