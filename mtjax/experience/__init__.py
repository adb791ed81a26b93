"""What learners learn from: replay, and what is drawn from it."""
