"""Recordings: times, readings, inputs, and what the first readings show."""
