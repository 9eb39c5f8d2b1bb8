"""Published recordings, ready to be fitted."""

from rigidjax._names import own_names
from rigidjax.datasets import toutatis as toutatis

__dir__ = own_names(__name__)
