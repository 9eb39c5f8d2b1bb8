"""Find the parameters of a model with the least cost."""
