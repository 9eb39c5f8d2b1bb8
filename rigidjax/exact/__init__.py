"""Answers without a solver."""

from rigidjax.exact.free_body import FreeBody as FreeBody, free_body as free_body
