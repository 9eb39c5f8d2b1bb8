"""Published recordings, ready to be fitted."""

from rigidjax._names import show
from rigidjax.datasets import toutatis as toutatis

show(__name__)
