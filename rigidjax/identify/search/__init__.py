"""Find the free numbers of a model with the least misfit."""
