"""What solvers of normal equations allow for rounding; here neither torch nor numba is loaded."""

RELATIVE_JITTER = 1e-12
"""Share of itself that is added to the diagonal: rounding over some hundred poses can take as much from it."""
