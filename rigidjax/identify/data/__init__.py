"""Hold recordings: their times, readings and inputs, and what the first readings show."""
