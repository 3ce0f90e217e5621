"""Mode-wise trimmed consensus (A. Mitra, S. Sundaram, Byzantine-Resilient Distributed Observers for LTI Systems, Automatica 2019).

The state is split into the modes of A, and each agent estimates each mode in one of two ways:

    a mode that it detects with its own sensors: by itself, whatever the others say (here with the steady Kalman filter of what it detects);
    a mode that it does not: z_i+ = J (mean of what is left of its parents' z_l without the F highest and the F lowest), number by number.

Parents are agreed upon beforehand. The agents that detect a mode know it. Then, round after round, each agent that hears 2F + 1 agents who
know it learns it from these. No F agents in a neighbourhood can then pull an honest agent out of the range of the honest ones. Modes that
die out need no consensus: every agent predicts them, and corrects what it sees of them.

It protects the agents that are not attacked from those that are. An agent whose own sensors are attacked is as wrong as its own filter.

Real modes are one number, complex pairs two; equal or nearly equal eigenvalues, defective ones included, make one block. Where the graph
does not give every agent its 2F + 1 parents for every mode: NotApplicable, naming the mode and the agents.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Count, Model, param
from tailgate.core.reach import MARGIN
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, Score
from tailgate.estimators.distributed.distributed_kalman import neighbours
from tailgate.estimators.filters.kalman import KalmanState, LinearFilter, broad, steady_state
from tailgate.estimators.parts import Detector, Filter, Mitigation

REFERENCE = "A. Mitra, S. Sundaram, Byzantine-Resilient Distributed Observers for LTI Systems, Automatica 108, 2019"
FAULTY = "F: attacked neighbours of an agent that are tolerated, of each mode"
CLUSTER = 1e-4  # eigenvalues this close are one
SHIFT = 1e-6  # distance of the inverse iteration's shift from the eigenvalue
ROUNDS = 40  # rounds of the inverse iteration
GOLDEN = 0.6180339887498949


class Block(NamedTuple):
    """A lasting mode: `eigenvalue` with imaginary part >= 0, V (n, m) its states as columns, W (m, n) with z = W x."""

    eigenvalue: complex
    V: Array
    W: Array


class Lesson(NamedTuple):
    """A mode, and the agents that learn it, each with its parents."""

    V: Array  # (n, m)
    W: Array  # (m, n)
    parents: tuple[tuple[int, tuple[int, ...]], ...]  # agent, and whom it listens to


class TrimmedPlan(NamedTuple):
    """The constants of LinearFilter, and the lessons."""

    A: Array
    B: Array
    c: Array
    C: Array
    Q: Array
    R: Array
    broad: Array
    held: Array  # (N, n, n) P- of what each agent detects itself; 0 for the rest
    lessons: tuple[Lesson, ...]


def _orthonormal(X: Array) -> Array:
    """Return the columns of X (n, m) made orthonormal from left to right, twice against rounding; dependent ones become 0."""
    out = np.zeros_like(X)
    for j in range(X.shape[1]):
        v = X[:, j] / max(float(np.max(np.abs(X[:, j]))), 1e-300)
        size = float(np.sqrt(num.dot(v, v)))
        for _ in range(2):
            for i in range(j):
                v = v - num.dot(v, out[:, i]) * out[:, i]
        left = float(np.sqrt(num.dot(v, v)))
        out[:, j] = v / left if left > 1e-12 * max(size, 1e-300) else 0.0
    return out


def _eigenspace(A: Array, value: complex, size: int) -> Array:
    """Return orthonormal columns (n, size) of the generalised eigenvectors of `value` and its conjugate, by inverse iteration."""
    shifted, eye = value + SHIFT, np.eye(len(A))
    P = A - shifted.real * eye
    if value.imag:
        P = num.product(P, P) + shifted.imag * shifted.imag * eye
    X: Array = np.multiply.outer(np.arange(1.0, len(A) + 1.0), np.arange(1.0, size + 1.0)) * GOLDEN % 1.0 - 0.5  # any full block will do
    for _ in range(ROUNDS):
        X = _orthonormal(num.solve(P, X))
    return X


def _complement(X: Array) -> Array:
    """Return orthonormal columns (n, n - k) that complete the k columns of X to a basis."""
    n, k = X.shape
    basis, out = _orthonormal(X), np.zeros((n, 0))
    for _ in range(n - k):
        rest = np.eye(n)
        for v in (*basis.T, *out.T):
            rest = rest - v[:, None] * num.matvec(rest.T, v)
        length = num.dot(rest.T, rest.T)
        out = np.concatenate([out, rest[:, [int(np.argmax(length))]]], axis=1)
        out = _orthonormal(np.concatenate([basis, out], axis=1))[:, k:]
    return out


def clusters(A: Array) -> list[tuple[complex, int]]:
    """Return the eigenvalues of A that do not die out, with imaginary part >= 0, rounded; and the number of states of each."""
    from scipy import linalg  # takes long to import

    left = sorted((complex(v) for v in linalg.eigvals(A) if v.imag >= -CLUSTER), key=lambda v: (v.real, v.imag))
    out = []
    while left:
        group = [left.pop(0)]
        for value in group:  # it grows on the way: neighbours of neighbours belong to it
            group += [v for v in left if abs(v - value) < CLUSTER]
            left = [v for v in left if abs(v - value) >= CLUSTER]
        re, im = (round(sum(part) / len(group), 9) for part in ([v.real for v in group], [v.imag for v in group]))
        real = abs(im) < CLUSTER
        if abs(complex(re, im)) >= 1.0 - MARGIN:
            out.append((complex(re, 0.0 if real else im), len(group) if real else 2 * len(group)))
    return out


def split(A: Array) -> tuple[list[Block], Block]:
    """Return the lasting modes of A, and one block of all that dies out.

    Only the rounded eigenvalues come from LAPACK; from them on the arithmetic is in fixed order. Raises NotApplicable for a chain of states
    that is too long for it.
    """
    found = clusters(A)
    dual = [_eigenspace(A.T, value, size) for value, size in found]
    V = [_eigenspace(A, value, size) for value, size in found]
    for (value, size), basis in zip(found, V, strict=True):
        if not basis.any(axis=0).all():
            wanted = "modes whose generalised eigenvectors differ by more than rounding"
            raise NotApplicable("defence trimmed_consensus", f"a chain of {size} states at the eigenvalue {value:g}", wanted)
    V.append(_complement(np.concatenate([*dual, np.zeros((len(A), 0))], axis=1)))
    W, first, out = num.solve(np.concatenate(V, axis=1), np.eye(len(A))), 0, []
    for value, basis in zip((*(value for value, _ in found), 0j), V, strict=True):
        out.append(Block(value, basis, W[first : first + basis.shape[1]]))
        first += basis.shape[1]
    return out[:-1], out[-1]


def detects(A: Array, C: Array, block: Block) -> bool:
    """Return True if the readings C x (q, n) determine all states of a block: its observability matrix has full rank."""
    J, rows = num.product(num.product(block.W, A), block.V), [num.product(C, block.V)]
    for _ in range(J.shape[0] - 1):
        rows.append(num.product(rows[-1], J))
    seen, size = np.concatenate(rows).T, max(1.0, float(np.max(np.abs(C), initial=0.0)))
    for _ in range(len(J)):  # states one after the other: the best seen goes, with its share of the others
        length = num.dot(seen, seen)
        i = int(np.argmax(length))
        if length[i] <= (MARGIN * size) ** 2:
            return False
        unit = seen[i] / np.sqrt(length[i])
        seen = seen - num.matvec(seen, unit)[:, None] * unit
        seen[i] = 0.0
    return True


def lessons(graph: Array, sources: list[int], faulty: int) -> tuple[tuple[tuple[int, tuple[int, ...]], ...], list[int]]:
    """Return (agent, parents) of those who can learn a mode that `sources` know, and those who cannot."""
    heard, known = neighbours(graph), set(sources)
    out: list[tuple[int, tuple[int, ...]]] = []
    while True:
        able = {i: tuple(j for j in near if j in known) for i, near in enumerate(heard) if i not in known}
        able = {i: parents for i, parents in able.items() if len(parents) >= 2 * faulty + 1}
        if not able:
            return tuple(sorted(out)), [i for i in range(len(heard)) if i not in known]
        out += able.items()
        known |= able.keys()


def trimmed_mean(z: Array, faulty: int) -> Array:
    """Return the mean (B, m) of z (B, p, m) over p, without the `faulty` highest and lowest of each number."""
    ranked = np.sort(z, axis=1)[:, faulty : z.shape[1] - faulty]
    total = ranked[:, 0]
    for place in range(1, ranked.shape[1]):
        total = total + ranked[:, place]
    return np.asarray(total / ranked.shape[1])


@register("filter", "trimmed_consensus", reference=REFERENCE)
@dataclass(frozen=True)
class TrimmedFilter(LinearFilter[TrimmedPlan]):
    """Local filters for what an agent detects, and a trimmed mean of its parents for every other mode."""

    faulty: Count = param(1, FAULTY)

    def prepare(self, model: Model) -> TrimmedPlan:
        lasting, rest = split(model.A)
        own: list[list[Block]] = [[] for _ in range(model.agents)]
        taught, missing = [], []
        for block in lasting:
            sources = [i for i in range(model.agents) if detects(model.A, model.C[i], block)]
            for i in sources:
                own[i].append(block)
            parents, lost = lessons(model.graph, sources, self.faulty)
            taught.append(Lesson(block.V, block.W, parents))
            if lost:
                shown = block.eigenvalue if block.eigenvalue.imag else block.eigenvalue.real
                missing.append(f"mode {shown:.4g}: agents {', '.join(map(str, lost))}")
        if missing:
            few = 2 * self.faulty + 1
            wanted = f"a graph in which every agent that does not detect a mode hears {few} or more who know it (2F + 1, F = {self.faulty})"
            raise NotApplicable("defence trimmed_consensus: agents without parents", "; ".join(missing), wanted)
        held = np.stack([self._local(model, i, [*blocks, rest]) for i, blocks in enumerate(own)])
        return TrimmedPlan(
            model.A, model.B, model.c, model.C, model.Q, model.R, broad(model), held, tuple(lesson for lesson in taught if lesson.parents)
        )

    def _local(self, model: Model, i: int, blocks: list[Block]) -> Array:
        """Return P- (n, n) of the steady filter of agent i for these blocks alone."""
        V, W = np.concatenate([b.V for b in blocks], axis=1), np.concatenate([b.W for b in blocks])
        if not V.shape[1]:
            return np.zeros_like(model.A)
        A, Q = num.product(num.product(W, model.A), V), num.product(num.product(W, model.Q), W.T)
        part = Model(
            A, np.zeros((len(A), 0)), np.zeros(len(A)), num.product(model.C[i], V)[None], Q, model.R[i : i + 1], np.eye(1, dtype=bool),
            model.dt, model.sensors,
        )  # fmt: skip
        P = num.product(num.product(V, steady_state(part)[0]), V.T)
        return np.asarray(0.5 * (P + P.T))

    def predict(self, plan: TrimmedPlan, state: KalmanState, known_u: Array) -> KalmanState:
        x = state.x.copy(order="K")
        for lesson in plan.lessons:
            z = num.matvec(lesson.W, state.x)
            for i, parents in lesson.parents:
                x[:, i] += num.matvec(lesson.V[None], trimmed_mean(z[:, parents], self.faulty) - z[:, i])
        return super().predict(plan, KalmanState(x, None), known_u)


@register("defence", "trimmed_consensus", reference=REFERENCE)
@dataclass(frozen=True)
class TrimmedConsensus(Composed):
    """Each mode by the own sensors, or by the trimmed mean of neighbours who know it."""

    faulty: Count = param(TrimmedFilter.faulty, FAULTY)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return TrimmedFilter(self.faulty), Score(), AcceptAll()
