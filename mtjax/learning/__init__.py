"""Acting, learning and evaluating in one compiled loop."""
