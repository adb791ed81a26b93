"""Physics engines behind one step."""
