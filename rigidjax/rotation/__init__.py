"""Hold rotations, public as `rj.so3`, `rj.quaternion`, `rj.euler`, `rj.mrp` and `rj.rodrigues`."""
