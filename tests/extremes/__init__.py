"""The operators at the extremes of physics and floating point: ``python -m pytest tests/extremes [--device cuda]``.

Every row is an operator at an extreme in one dtype: the worst error against a brute-force reference
(``tests/brute_force.py``), the bound that is asserted and where it comes from, and whether values and gradients are
finite, or which other outcome is the documented one. ``--table FILE`` writes the rows.
"""

from extremes import autograd, light, sizes, spikes, warp
from extremes.table import Case

CASES: list[Case] = [*light.CASES, *spikes.CASES, *warp.CASES, *sizes.CASES, *autograd.CASES]
