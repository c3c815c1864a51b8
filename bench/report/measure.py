"""Measures that several parts use."""
import numpy as np


def lattice_residual(X, value, spacing):
    """(n,) what a plane through a particle's 5 x 5 neighbours on the lattice of reference positions X (n, 2) leaves of
    its value: noise from particle to particle, whatever the field."""
    index = np.rint((X - X.min(axis=0)) / spacing).astype(int) + 2
    grid = np.full(index.max(axis=0) + 3, np.nan)
    grid[index[:, 0], index[:, 1]] = value
    offsets = np.array([(i, j) for i in range(-2, 3) for j in range(-2, 3)])
    near = grid[index[:, :1] + offsets[:, 0], index[:, 1:] + offsets[:, 1]]  # (n, 25)
    weight = np.isfinite(near).astype(float)
    basis = np.column_stack([np.ones(25), offsets])
    matrix = np.einsum("nk,ka,kb->nab", weight, basis, basis, optimize=True)
    matrix += 1e-12 * np.eye(3)  # a particle with no neighbours keeps its own value
    fit = np.linalg.solve(matrix, np.einsum("nk,ka->na", np.nan_to_num(near), basis)[:, :, None])[:, 0, 0]
    return value - fit


def rms(value):
    return float(np.sqrt(np.mean(np.square(value))))


def rate(h, error):
    """Observed order of convergence: slope of log(error) over log(h), by least squares."""
    return float(np.polyfit(np.log(h), np.log(error), 1)[0])
