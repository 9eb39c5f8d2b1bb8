"""Find the times at which steps end, and evaluate laws on the correct side of their jumps."""
