"""Coverage of a sphere by directions: the cells of a geodesic grid.

The grid is an icosahedron whose triangles were divided in four: 80 cells of nearly equal size, the
same grid as in other compass calibrations.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_GOLDEN: Final = (1.0 + math.sqrt(5.0)) / 2.0
_FACES: Final = (
    (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11),
    (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8),
    (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9),
    (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1),
)  # fmt: skip


def _make_cells() -> FloatArray:
    a, b = 1.0, _GOLDEN
    corners = np.array(
        [
            (-a, b, 0), (a, b, 0), (-a, -b, 0), (a, -b, 0), (0, -a, b), (0, a, b),
            (0, -a, -b), (0, a, -b), (b, 0, -a), (b, 0, a), (-b, 0, -a), (-b, 0, a),
        ]
    )  # fmt: skip
    cells = []
    for face in _FACES:
        p, q, r = (_unit(corners[n]) for n in face)
        pq, qr, rp = _unit(p + q), _unit(q + r), _unit(r + p)
        cells += [(p, pq, rp), (q, qr, pq), (r, rp, qr), (pq, qr, rp)]
    return np.array(cells)


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


CELLS: Final = _make_cells()
"""Corners of the cells on the unit sphere, shape (80, 3, 3)."""
_MIDDLES: Final = np.array([_unit(cell.sum(axis=0)) for cell in CELLS])


def seen_cells(vectors: FloatArray) -> list[bool]:
    """Return which cells the vectors from the origin point into.

    Parameters
    ----------
    vectors : ndarray, shape (n, 3)
        Any length but zero; rows that are not finite are ignored.

    Returns
    -------
    list of bool
        One for each of `CELLS`.
    """
    seen = [False] * len(CELLS)
    finite = vectors[np.isfinite(vectors).all(axis=1)] if len(vectors) else vectors
    if len(finite):
        for cell in np.unique((finite @ _MIDDLES.T).argmax(axis=1)).tolist():
            seen[cell] = True
    return seen
