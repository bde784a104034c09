"""The Pareto front of cost and quality."""

from __future__ import annotations

from collections.abc import Sequence


def pareto_front(costs: Sequence[float], values: Sequence[float]) -> list[int]:
    """Return which of some points are on the front, cheapest first.

    A point is on it if no other costs no more and is worth no less, one of them strictly. Equal points are all on it.

    Args:
        costs: less is better.
        values: more is better.

    Example:
        >>> pareto_front([1.0, 2.0, 3.0, 4.0], [20.0, 24.0, 23.0, 25.0])
        [0, 1, 3]
    """
    front: list[int] = []
    for point in sorted(range(len(costs)), key=lambda i: (costs[i], -values[i])):
        best = front[-1] if front else None
        equal = best is not None and (costs[best], values[best]) == (costs[point], values[point])
        if best is None or values[point] > values[best] or equal:
            front.append(point)
    return front
