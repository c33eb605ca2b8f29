"""Errors of a hand in plain NumPy, as the paper defines them: what the tables are compared with."""

import numpy as np


def error_mm(found: np.ndarray, truth: np.ndarray) -> float:
    return float(1000 * np.sqrt(((found - truth) ** 2).sum(-1)).mean())


def aligned(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Procrustes with scale, rotation or reflection, and shift."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    a, norm = a / np.linalg.norm(a), np.linalg.norm(b)
    u, s, vt = np.linalg.svd(a.T @ (b / norm))
    return norm * s.sum() * a @ (u @ vt) + truth.mean(0)


def area(found: np.ndarray, truth: np.ndarray, limit_mm: float, steps: int) -> float:
    """Under the curve of correct points, of one hand, by trapezoids."""
    apart = 1000 * np.linalg.norm(found - truth, axis=-1)
    limits = np.linspace(0, limit_mm, steps)
    right = np.array([(apart <= limit).mean() for limit in limits])
    return float(((right[1:] + right[:-1]) / 2).mean())


def f_score(found: np.ndarray, truth: np.ndarray, limit_mm: float) -> float:
    """Of the points near any point of the other hand, both ways."""
    apart = 1000 * np.linalg.norm(found[:, None] - truth[None], axis=-1)
    precision, recall = ((apart.min(axis) < limit_mm).mean() for axis in (1, 0))
    return float(2 * precision * recall / max(precision + recall, 1e-12))
