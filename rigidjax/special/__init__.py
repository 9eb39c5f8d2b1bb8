from rigidjax._names import own_names

__dir__ = own_names(__name__)
