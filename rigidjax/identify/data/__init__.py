"""Hold recordings (times, readings and inputs), and find initial states from the first readings."""
