"""Solves the spherical quadrature rules that `warp_psf/basis/quadrature.txt` holds, and prints that file.

    python benchmarks/solve_quadrature.py > warp_psf/basis/quadrature.txt

A rule whose points come in antipodal pairs of equal weight integrates every odd function exactly. Any even polynomial
of degree k or less is, on the sphere, a homogeneous one of degree k (multiply by x^2 + y^2 + z^2 = 1), so that such a
rule of even k is exact up to the degree k + 1 if it integrates the (k + 1)(k + 2) / 2 monomials of degree k. A weight w
and direction d enter those only as the vector v = w^(1/k) d: the rule is found as one vector for each pair, and its
weights are positive by construction. The equations are solved by Levenberg-Marquardt from many jittered Fibonacci
lattices; of the solutions, the one with the most even weights is kept.
"""

import sys

import numpy as np

RULES = {16: 5, 32: 9, 64: 13, 96: 15, 176: 21}  # points: degree
STARTS = 40
ITERATIONS = 500
# Of the mean weight; rounding leaves about 1e-15.
SOLVED = 1e-13
# A start is moved by this share of the distance between neighbours: enough to reach different, even solutions.
JITTER = 0.12


def main() -> None:
    print("# Antipodal quadrature on the unit sphere; one point of each pair. Made by benchmarks/solve_quadrature.py.")
    print("# points of the rule, direction x y z, weight in steradians")
    for points, degree in RULES.items():
        directions, weights = best_rule(points // 2, degree - 1)
        ratio = weights.max() / weights.min()
        print(f"{points} points: degree {degree}, largest weight / smallest {ratio:.3f}", file=sys.stderr)
        for (x, y, z), weight in zip(directions, weights, strict=True):
            print(f"{points} {x:.17g} {y:.17g} {z:.17g} {weight:.17g}")


def best_rule(pairs: int, power: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [pairs, 3] and weights [pairs] of the most evenly weighted rule found.

    Raises:
        RuntimeError: no start led to a solution.
    """
    rng = np.random.default_rng(0)
    best, best_ratio = None, np.inf
    for _ in range(STARTS):
        vectors = solve(jittered_hemisphere(pairs, rng), power)
        if vectors is None:
            continue
        weights = np.linalg.norm(vectors, axis=1) ** power
        if weights.max() / weights.min() < best_ratio:
            best, best_ratio = (vectors, weights), weights.max() / weights.min()
    if best is None:
        raise RuntimeError(f"no rule of {2 * pairs} points and degree {power + 1} was found; ask for a lower degree")
    vectors, weights = best
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True), weights * (2.0 * np.pi / weights.sum())


def jittered_hemisphere(pairs: int, rng: np.random.Generator) -> np.ndarray:
    """Unit directions [pairs, 3], spread over the upper hemisphere."""
    index = np.arange(pairs) + 0.5
    z = index / pairs
    phi = np.pi * (3.0 - np.sqrt(5.0)) * index
    directions = np.stack([np.sqrt(1.0 - z * z) * np.cos(phi), np.sqrt(1.0 - z * z) * np.sin(phi), z], axis=1)
    directions += JITTER * np.sqrt(2.0 * np.pi / pairs) * rng.normal(size=directions.shape)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def solve(vectors: np.ndarray, power: int) -> np.ndarray | None:
    """The vectors [pairs, 3] that integrate all monomials of degree `power`, by Levenberg-Marquardt, or None."""
    exponents, scale = monomials(power)
    target = len(vectors) * scale * monomial_means(exponents)
    damping = 1e-2
    residual = scale * evaluate(vectors, exponents).sum(axis=0) - target
    for _ in range(ITERATIONS):
        if np.abs(residual).max() < SOLVED:
            return vectors
        jacobian = (scale * derivatives(vectors, exponents)).reshape(-1, len(exponents))
        normal = jacobian @ jacobian.T + damping * np.eye(len(jacobian))
        moved = vectors - np.linalg.solve(normal, jacobian @ residual).reshape(-1, 3)
        moved_residual = scale * evaluate(moved, exponents).sum(axis=0) - target
        if moved_residual @ moved_residual < residual @ residual:
            vectors, residual = moved, moved_residual
            damping = max(damping / 5.0, 1e-12)
        else:
            damping *= 4.0
    return None


def monomials(power: int) -> tuple[np.ndarray, np.ndarray]:
    """Exponents int [M, 3] that sum to `power`, and the scale [M] that makes their set invariant to rotation."""
    exponents = np.array([(a, b, power - a - b) for a in range(power + 1) for b in range(power + 1 - a)])
    factorials = np.cumprod(np.maximum(np.arange(power + 1), 1)).astype(np.float64)
    return exponents, np.sqrt(factorials[power] / factorials[exponents].prod(axis=1))


def monomial_means(exponents: np.ndarray) -> np.ndarray:
    """The mean [M] of each monomial over the unit sphere: (a-1)!! (b-1)!! (c-1)!! / (a+b+c+1)!! if all are even."""

    def double_factorial(n: int) -> float:
        return float(np.prod(np.arange(n, 0, -2, dtype=np.float64)))

    means = [np.prod([double_factorial(e - 1) for e in row]) / double_factorial(row.sum() + 1) for row in exponents]
    return np.where((exponents % 2 == 0).all(axis=1), means, 0.0)


def evaluate(vectors: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Monomials [pairs, M] of `vectors` [pairs, 3]."""
    return (vectors[:, None, :] ** exponents).prod(axis=2)


def derivatives(vectors: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Derivatives [pairs, 3, M] of the monomials by each component."""
    rows = []
    for axis in range(3):
        lowered = exponents.copy()
        lowered[:, axis] = np.maximum(lowered[:, axis] - 1, 0)
        rows.append(exponents[:, axis] * evaluate(vectors, lowered))
    return np.stack(rows, axis=1)


if __name__ == "__main__":
    main()
