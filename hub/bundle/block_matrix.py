"""Normal matrices of the cameras: sums of blocks over cameras that share observations, and their inverses.

Where each camera shares labels with few others, the matrix is block tridiagonal in the order of Cuthill and McKee
("Reducing the bandwidth of sparse symmetric matrices", 1969): of its inverse only the blocks about the diagonal are
formed (Takahashi, Fagan and Chen, 1973), and products with a few columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from protocols.geometry.types import Floats, Ints

_COLUMNS_AT_ONCE = 512  # of an inverse, that are solved for together


@dataclass(frozen=True, slots=True, eq=False)
class BlockSum:
    """A symmetric matrix (p, p): values (p,) on its diagonal, and blocks (k, k) over columns (k,), no one twice."""

    on_diagonal: Floats
    parts: tuple[tuple[Ints, Floats], ...] = ()

    @property
    def size(self) -> int:
        """p."""
        return len(self.on_diagonal)

    def diagonal(self) -> Floats:
        """(p,)."""
        out = self.on_diagonal.copy()
        for columns, block in self.parts:
            out[columns] += np.diagonal(block)
        return out

    def dense(self) -> Floats:
        """(p, p)."""
        out = np.diag(self.on_diagonal)
        for columns, block in self.parts:
            out[np.ix_(columns, columns)] += block
        return out

    def __add__(self, other: BlockSum) -> BlockSum:
        """The sum of both."""
        return BlockSum(self.on_diagonal + other.on_diagonal, self.parts + other.parts)

    def columns(self, chosen: Ints) -> Floats:
        """(p, k) the chosen columns, no one twice."""
        out = np.zeros((self.size, len(chosen)))
        out[chosen, np.arange(len(chosen))] = self.on_diagonal[chosen]
        for columns, block in self.parts:
            _, mine, place = np.intersect1d(columns, chosen, assume_unique=True, return_indices=True)
            if len(mine):
                out[np.ix_(columns, place)] += block[:, mine]
        return out

    def restricted(self, kept: Ints) -> BlockSum:
        """The rows and columns ``kept``, in ascending order."""
        place, parts = np.full(self.size, -1), []
        place[kept] = np.arange(len(kept))
        for columns, block in self.parts:
            inside = place[columns] >= 0
            parts.append((place[columns[inside]], block[np.ix_(inside, inside)]))
        return BlockSum(self.on_diagonal[kept], tuple(parts))

    def __matmul__(self, right: Floats) -> Floats:
        """(p,) of (p,), (p, k) of (p, k)."""
        out = (self.on_diagonal * right.T).T
        for columns, block in self.parts:
            out[columns] += block @ right[columns]
        return out

    def factored(self) -> OrderedFactor | None:
        """Its factor in a narrow order; None if there is none. Raises LinAlgError if it is not positive definite."""
        if 2 * max((len(columns) for columns, _ in self.parts), default=0) >= self.size:
            return None
        starts = np.cumsum([0, *(len(columns) for columns, _ in self.parts)])
        every = np.concatenate([columns for columns, _ in self.parts])
        members = csr_array((np.ones(len(every)), every, starts), shape=(len(self.parts), self.size))
        order = reverse_cuthill_mckee(csr_array(members.T @ members), symmetric_mode=True)
        place = np.argsort(order)
        width = 1 + max(int(np.ptp(place[columns])) for columns, _ in self.parts if len(columns))
        if 2 * width > self.size:
            return None
        windows = np.zeros((-(-self.size // width), 2 * width, 2 * width))
        for columns, block in self.parts:
            if len(columns):
                window = int(place[columns].min()) // width
                inside = place[columns] - window * width
                windows[window][np.ix_(inside, inside)] += block
        unused = np.arange(self.size - (len(windows) - 1) * width, width)
        windows[-1, unused, unused] = 1.0
        diagonal = windows[:, :width, :width].copy()
        diagonal[1:] += windows[:-1, width:, width:]
        diagonal[place // width, place % width, place % width] += self.on_diagonal
        return OrderedFactor(place, BlockTridiagonal.of(diagonal, windows[:, :width, width:]))


@dataclass(frozen=True, slots=True, eq=False)
class BlockTridiagonal:
    """A factored symmetric matrix. pivots: (k, b, b) inverses of its pivots. above: (k, b, b) beside the diagonal, of
    which the last block is not used."""

    pivots: Floats
    above: Floats

    @classmethod
    def of(cls, diagonal: Floats, above: Floats, definite: bool = True) -> BlockTridiagonal:
        """Of blocks (k, b, b) on the diagonal and above it.

        definite: whether it has to be positive definite, else LinAlgError is raised; rounding may leave a matrix that
        is semidefinite, as of a path where nobody observes it, slightly below.
        """
        pivots = np.empty_like(diagonal)
        for i, block in enumerate(diagonal):
            pivot = block - above[i - 1].T @ pivots[i - 1] @ above[i - 1] if i else block
            factor, info = dpotrf(pivot)
            if info and definite:
                raise np.linalg.LinAlgError(f"block {i} of a matrix is not positive definite")
            if info:
                pivots[i] = np.linalg.inv(pivot)
                continue
            inverse = dpotri(factor)[0]  # its upper triangle
            pivots[i] = inverse + inverse.T
            pivots[i].flat[:: len(block) + 1] *= 0.5
        return cls(pivots, above)

    def solve(self, right: Floats) -> Floats:
        """The solution (k b, m) of right (k b, m)."""
        out = right.reshape(*self.pivots.shape[:2], right.shape[1]).copy()
        for i in range(1, len(out)):
            out[i] -= self.above[i - 1].T @ (self.pivots[i - 1] @ out[i - 1])
        out[-1] = self.pivots[-1] @ out[-1]
        for i in range(len(out) - 2, -1, -1):
            out[i] = self.pivots[i] @ (out[i] - self.above[i] @ out[i + 1])
        return out.reshape(right.shape)

    def inverse_blocks(self) -> Floats:
        """Blocks (k, 2 b, 2 b) of the inverse about its diagonal: block i covers rows b i … b i + 2 b - 1."""
        count, size = self.pivots.shape[:2]
        out = np.zeros((count, 2 * size, 2 * size))
        last = self.pivots[-1]
        out[-1, :size, :size] = last
        for i in range(count - 2, -1, -1):
            carry = self.pivots[i] @ self.above[i]
            corner = -carry @ last
            now = self.pivots[i] - corner @ carry.T
            out[i, :size, :size], out[i, size:, size:] = now, last
            out[i, :size, size:], out[i, size:, :size] = corner, corner.T
            last = now
        return out


@dataclass(frozen=True, slots=True, eq=False)
class OrderedFactor:
    """A matrix (p, p) that is block tridiagonal once its rows and columns are at ``place`` (p,), factored."""

    place: Ints
    factor: BlockTridiagonal

    def solve(self, right: Floats) -> Floats:
        """The solution (p, m) of right (p, m)."""
        count, width = self.factor.pivots.shape[:2]
        ordered = np.zeros((count * width, right.shape[1]))
        ordered[self.place] = right
        return self.factor.solve(ordered)[self.place]


@dataclass(frozen=True, slots=True, eq=False)
class DenseCovariance:
    """A covariance (p, p)."""

    matrix: Floats

    def __matmul__(self, right: Floats) -> Floats:
        """(p,) of (p,), (p, m) of (p, m)."""
        return np.asarray(self.matrix @ right)

    def diagonal(self) -> Floats:
        """(p,)."""
        return np.diagonal(self.matrix)

    def submatrix(self, columns: Ints) -> Floats:
        """(k, k)."""
        return self.matrix[np.ix_(columns, columns)]


@dataclass(frozen=True, eq=False)
class SparseCovariance:
    """A covariance (p, p): the inverse of a factored matrix, plus ``low @ middle @ low.T`` with low (p, q).

    moves: (p,) 0 of parameters that are held, where rounding would leave what is lost of large numbers; else 1.
    """

    factored: OrderedFactor
    low: Floats
    middle: Floats
    moves: Floats

    def __matmul__(self, right: Floats) -> Floats:
        """(p,) of (p,), (p, m) of (p, m)."""
        matrix, moves = right.reshape(len(self.low), -1), self.moves[:, None]
        step = self.factored.solve(moves * matrix) + self.low @ (self.middle @ (self.low.T @ (moves * matrix)))
        return (moves * step).reshape(right.shape)

    @cached_property
    def _blocks(self) -> Floats:
        return self.factored.factor.inverse_blocks()

    def diagonal(self) -> Floats:
        """(p,)."""
        block, inside = np.divmod(self.factored.place, self._blocks.shape[1] // 2)
        own = self._blocks[block, inside, inside] + ((self.low @ self.middle) * self.low).sum(axis=1)
        return np.asarray(self.moves * own)

    def submatrix(self, columns: Ints) -> Floats:
        """(k, k). Of cameras that share observations it is at hand; others are solved for."""
        places, width = self.factored.place[columns], self._blocks.shape[1] // 2
        first = int(places.min(initial=len(self.low))) // width
        if places.max(initial=0) < (first + 2) * width:
            inside = places - first * width
            found = self._blocks[min(first, len(self._blocks) - 1)][np.ix_(inside, inside)]
        else:
            found = np.empty((len(columns), len(columns)))
            for begin in range(0, len(columns), _COLUMNS_AT_ONCE):
                some = columns[begin : begin + _COLUMNS_AT_ONCE]
                units = np.zeros((len(self.low), len(some)))
                units[some, np.arange(len(some))] = 1.0
                found[:, begin : begin + len(some)] = self.factored.solve(units)[columns]
        low, moves = self.low[columns], self.moves[columns]
        return np.asarray(moves[:, None] * (found + low @ self.middle @ low.T) * moves)


ParameterCovariance = DenseCovariance | SparseCovariance
