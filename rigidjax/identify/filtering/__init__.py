"""Kalman filter and smoother for unknown torques."""
