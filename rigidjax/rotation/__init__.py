"""Rotations: matrices, quaternions, Euler angles, Rodrigues parameters.

Public as `rj.so3`, `rj.quaternion`, `rj.euler`, `rj.mrp` and `rj.rodrigues`.
"""
