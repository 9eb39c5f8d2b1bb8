"""Follow states and unknown torques by a Kalman filter and a smoother."""
