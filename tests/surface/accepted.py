"""What the fuzz finds and is right, or is known and not mended here: each with its reason."""

import fnmatch

# (row, argument: replacement, what came of it, reason), as patterns; the first that fits counts.
ACCEPTED: list[tuple[str, str, str, str]] = []


def reason(name: str, where: str, what: str) -> str | None:
    """Why this is accepted; `None` if it is not."""
    for row, place, came, why in ACCEPTED:
        if all(fnmatch.fnmatchcase(*pair) for pair in ((name, row), (where, place), (what, came))):
            return why
    return None
