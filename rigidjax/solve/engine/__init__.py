"""Run adaptive steps, record them, and repeat them in derivatives."""
