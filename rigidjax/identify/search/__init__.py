"""The search for the least misfit."""
