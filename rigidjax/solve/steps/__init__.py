"""Take one step of a method, or equal steps."""
