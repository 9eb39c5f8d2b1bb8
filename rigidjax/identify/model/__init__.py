"""From free numbers to bodies, motions and the errors of all readings."""
