"""Pairs of frequencies that the times of the readings hardly distinguish, and their refinement."""

import numpy as np

from rigidjax.tumblers.lattice_series import Sums, misfits_of, side_peaks

# Pairs nearer than this, in 1/span, count as one.
NEAR = 0.25
# Pairs whose aliases are tried, in at most so many rounds.
SEEDS, ROUNDS = 16, 3


def aliases_of(pairs: np.ndarray, peaks: np.ndarray) -> np.ndarray:
    """Pairs (M, 2) that may fit the same readings: moved by side peaks or half of them, and
    related.
    """
    moves = np.unique(np.concatenate([[0.0], *((p, -p, p / 2, -p / 2) for p in peaks)]))
    first, second = pairs.T[:, :, None]
    moved = [
        np.stack([first + a, second + b], axis=-1) for a in moves for b in moves if a != 0 or b != 0
    ]
    related = ((first / 2, second), (2 * first, second), (first, second / 2), (first, 2 * second))
    related += ((first, second + first), (first, second - first))
    rows = [*moved, *(np.stack(one, axis=-1) for one in related)]
    # (f₁, −f₂) makes the same lines.
    return np.abs(np.concatenate(rows).reshape(-1, 2))


def with_aliases(
    table: Sums, pairs: np.ndarray, misfits: np.ndarray, highest: float, order: int
) -> tuple[np.ndarray, np.ndarray]:
    """The pairs, and aliases of the best of them, in rounds until no better one is found."""
    peaks = side_peaks(table, highest)
    around = 0.2 * np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)], float)
    for _ in range(ROUNDS):
        seeds = pairs[distinct(pairs, misfits, SEEDS)]
        more = aliases_of(seeds, peaks)
        more = (more[:, None] + around).reshape(-1, 2)
        more = more[((more > 0.5) & (more < highest)).all(axis=1)]
        if not len(more):
            break
        best = distinct(more, misfits_of(table, more, order), 2 * SEEDS)
        more, new = refined(table, more[best], order)
        before = misfits.min()
        pairs, misfits = np.concatenate([pairs, more]), np.concatenate([misfits, new])
        if not new.min() < before * (1 - 1e-3):
            break
    return pairs, misfits


def distinct(pairs: np.ndarray, misfits: np.ndarray, count: int) -> list[int]:
    """The indices of `count` pairs that differ, in the order of their misfits."""
    kept: list[int] = []
    for index in np.argsort(misfits)[:20_000]:
        if not kept or np.abs(pairs[kept] - pairs[index]).max(axis=1).min() > NEAR:
            kept.append(int(index))
        if len(kept) == count:
            break
    return kept


def refined(table: Sums, pairs: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Descend from neighbour to neighbour; the steps become shorter if no neighbour is lower."""
    steps = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)], float)
    size = np.full(len(pairs), 0.08)
    least = np.full(len(pairs), np.inf)
    for _ in range(9):
        around = pairs[:, None] + size[:, None, None] * steps
        found = misfits_of(table, around.reshape(-1, 2), order).reshape(len(pairs), -1)
        best = found.argmin(axis=1)
        least = found.min(axis=1)
        pairs = pairs + size[:, None] * steps[best]
        size = np.where(best == 4, 0.4 * size, size)
    return pairs, least
