"""Lines of ordinary numpy code, made by chance: expressions of arrays (B, 3) and of Python's numbers, and statements that write to arrays.

`f8` to `b` are arrays of each type; `p`, `q`, `n` and `k` are numbers, which traced code has as parameters.
"""

import random
from collections.abc import Callable

import numpy as np

ROWS = 33
KINDS = ("f8", "f4", "i8", "i4", "i2", "i1", "u8", "u4", "u1", "b")
NUMBERS = {"p": 2.5, "q": -0.75, "n": 3, "k": 7}
ARITHMETIC = ("+", "-", "*", "/", "+", "*", "//", "%", "&", "|", "^", "<", "<=", "==", "!=", ">", ">=", "<<", ">>")
OF_TWO = (
    "add", "subtract", "multiply", "true_divide", "minimum", "maximum", "logical_and", "logical_or", "logical_xor", "less", "equal",
    "copysign", "hypot", "power", "mod",
)  # fmt: skip
OF_ONE = (
    "sqrt", "abs", "square", "floor", "ceil", "rint", "trunc", "sign", "isfinite", "isnan", "isinf", "signbit", "negative", "positive",
    "logical_not", "invert", "reciprocal", "fabs", "exp", "round", "nan_to_num",
)  # fmt: skip
TYPES = ("float", "int", "bool", "np.float32", "np.int8", "np.uint8", "np.int32", "np.int64")


def arrays(seed: int) -> dict[str, np.ndarray]:
    """Return an array (ROWS, 3) of each type, with its least and largest numbers among others."""
    chance, out = np.random.default_rng(seed), {}
    for name in KINDS:
        dtype = np.dtype(name.replace("b", "?"))
        rare = chance.random((ROWS, 3)) < 0.2
        if dtype.kind == "f":
            special = chance.choice([0.0, -0.0, 1.0, np.inf, np.nan, -2.0], (ROWS, 3))
            out[name] = np.where(rare, special, chance.normal(size=(ROWS, 3)) * 3).astype(dtype)
        elif dtype.kind == "b":
            out[name] = chance.random((ROWS, 3)) < 0.5
        else:
            limits = np.iinfo(dtype)
            special = chance.choice(np.array([limits.min, limits.max, 0], dtype), (ROWS, 3))
            out[name] = np.where(rare, special, chance.integers(0 if dtype.kind == "u" else -9, 9, (ROWS, 3)).astype(dtype))
    return out


class Lines:
    """A generator of code for a seed."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)

    def one(self, *choices: str | Callable[[], str]) -> str:
        made = self.chance.choice(choices)
        return made if isinstance(made, str) else made()

    def number(self, depth: int = 1) -> str:
        """Return an expression of Python's numbers."""
        at, deeper = self.chance.random(), depth - 1
        if depth <= 0 or at < 0.45:
            return self.one("p", "q", "n", "k", "p", "n", "2", "3.5", "-1", "0.0", "True", "300", "1e-3")
        if at < 0.75:
            return f"({self.number(deeper)} {self.one('+', '-', '*', '/', '//', '%', '+', '*', '<', '>=', '==')} {self.number(deeper)})"
        if at < 0.85:
            return f"({self.one('-', '+', 'abs', 'round', 'float', 'int', 'bool')}({self.number(deeper)}))"
        if at < 0.9:
            return f"({self.number(deeper)} ** {self.one('2', '0.5', 'n', 'q', '-1')})"
        function = self.one("sqrt(", "abs(", "minimum(p, ", "maximum(n, ", "add(q, ", "negative(", "square(", "floor(", "float64(", "asarray(", "sign(")
        return f"np.{function}{self.number(deeper)})"

    def array(self, depth: int) -> str:
        """Return an expression of the shape (B, 3)."""
        if depth <= 0:
            return self.one("f8", "f8", "f4", "i8", "i8", "i4", "i2", "i1", "u8", "u4", "u1", "b", "b")

        def a() -> str:
            return self.array(depth - 1)

        def s() -> str:
            return self.number(2) if self.chance.random() < 0.6 else a()

        def pair(between: str) -> str:
            both = [a(), s()]
            self.chance.shuffle(both)
            return between.join(both)

        at = self.chance.random()
        if at < 0.22:
            return f"({pair(f' {self.one(*ARITHMETIC)} ')})"
        if at < 0.30:
            return f"np.{self.one(*OF_TWO)}({pair(', ')})"
        if at < 0.40:
            return f"np.{self.one(*OF_ONE)}({a()})"
        if at < 0.44:
            return f"({self.one('-', '~', '+', 'abs')}({a()}))"
        if at < 0.52:
            return f"np.where({self.mask(depth - 1)}, {s()}, {a()})"
        if at < 0.57:
            return self.one(f"np.clip({a()}, {s()}, {s()})", f"({a()}).clip({s()}, {s()})", f"np.clip({a()}, None, {s()})", f"num.clip({a()}, {s()}, 2.0)")
        if at < 0.60:
            default = self.one("", f", {self.number(1)}", f", default={self.number(1)}")
            return f"np.select([{self.mask(depth - 1)}, {self.mask(depth - 1)}], [{a()}, {s()}]{default})"
        if at < 0.66:
            return f"({a()}).astype({self.one(*TYPES)}{self.one('', '', ', copy=False')})"
        if at < 0.70:
            return f"({a()}) ** {self.one('2', '0.5', 'n', 'p', '1', 'np.float32(2)', '2.0')}"
        if at < 0.80:
            return self.shaped(depth)
        if at < 0.88:
            return f"({self.reduction(depth)})[:, None] + {a()}"
        if at < 0.91:
            return f"np.{self.one('zeros_like', 'ones_like')}({a()}{self.one('', ', dtype=float', ', dtype=int')})"
        if at < 0.94:
            return f"np.full_like({a()}, {s()}{self.one('', ', dtype=float', ', dtype=np.int8')})"
        return f"np.full(({a()}).shape, {self.number(1)}{self.one('', ', dtype=float', ', float', ', np.float32')}) + {a()}"

    def mask(self, depth: int) -> str:
        at = self.chance.random()
        if at < 0.3 or depth <= 0:
            return "b"
        other = self.number(2) if self.chance.random() < 0.6 else self.array(depth - 1)
        return f"({self.array(depth - 1)} {self.one('<', '<=', '>', '>=', '==', '!=')} {other})"

    def shaped(self, depth: int) -> str:
        """Return an expression that reads numbers at other places."""

        def a() -> str:
            return f"({self.array(depth - 1)})"

        return self.one(
            lambda: f"{a()}[:, ::-1]", lambda: f"{a()}[:, [2, 0, 1]]", lambda: f"{a()}[:, n - 2, None] * {self.number(1)}",
            lambda: f"{a()}.T.T", lambda: f"np.flip({a()}, axis=1)", lambda: f"np.roll({a()}, 1, axis={self.one('1', '-1', '0')})",
            lambda: f"np.stack([{a()}[:, 0], {a()}[:, 1], {a()}[:, 2]], axis=1)", lambda: f"np.column_stack([{a()}[:, 0], {a()}[:, 1:]])",
            lambda: f"np.concatenate([{a()}[:, :1], {a()}[:, 1:]], axis=1)",
            lambda: f"np.concatenate([{a()}, {a()}], axis={self.one('0', '1')})", lambda: f"{a()}.reshape(len(f8), 3, 1)[..., 0]",
            lambda: f"np.repeat({a()}[:, :1], 3, axis={self.one('1', '0')})", lambda: f"np.broadcast_to({a()}[:, :1], (len(f8), 3))",
            lambda: f"np.array([{a()}[:, 0], {a()}[:, 1], {a()}[:, 2]]).T", lambda: f"np.asarray({a()}, dtype=float)",
            lambda: f"np.array([p, n, {self.number(1)}]) * {a()}", lambda: f"np.swapaxes({a()}[:, None], 1, 2)[..., 0]",
            lambda: f"{a()}[:, :n] + {a()}[..., -3:]", lambda: f"np.expand_dims({a()}, 1).squeeze(1)",
            lambda: f"num.take(np.arange(7.0), {a()}.astype(int) % 7)", lambda: f"num.pick({a()}, {a()}[:, 0].astype(int) % 3)[:, None] + f8",
            lambda: f"num.put({a()}, {a()}[:, 0].astype(int) % 3, {a()}[:, 1])", lambda: f"num.exp({a()})", lambda: f"num.log({a()})",
            lambda: f"num.matvec(np.array([[[1.0, 2.0, 0.5]] * 3]), {a()})", lambda: f"num.dot({a()}, {a()})[:, None] + f8",
            lambda: f"np.tile({a()}[:, :1], 3)", lambda: f"np.cumsum({a()}, axis=1)", lambda: f"np.minimum.accumulate({a()}, axis=1)",
            lambda: f"np.logical_or.accumulate({a()}, axis=1)", lambda: f"np.diff({a()}, axis=1, prepend=0.0)", lambda: f"np.isin({a()}, [0, 1, 2])",
            lambda: f"np.add({a()}, {self.number(1)}, dtype={self.one('float', 'np.float32', 'np.int64')})", lambda: f"np.square({a()}, dtype=float)",
            lambda: f"np.take({a()}, [0, 2, 1], axis=1)", lambda: f"np.round({a()}, 1)", lambda: f"{a()}[b[:, 0]]", lambda: f"{a()} @ np.eye(3)",
            lambda: f"{a()} if isinstance({self.number(1)}, {self.one('int', 'float', '(int, float)', 'np.ndarray')}) else {a()}",
            lambda: f"{a()} if isinstance({a()}, np.ndarray) else {a()}", lambda: f"{a()} + len(n * [0.0]) + sum([p] * n)",
        )  # fmt: skip

    def reduction(self, depth: int) -> str:
        """Return an expression of the shape (B,)."""
        a = f"({self.array(depth - 1)})"
        return self.one(
            f"{a}.sum(axis={self.one('1', '-1', '0')})", f"np.sum({a}, axis=1{self.one('', ', dtype=float', ', dtype=np.int64')})",
            f"np.max({a}, axis=1)", f"{a}.min(axis=1)", f"np.any({a}, axis=1)", f"{a}.all(axis=-1)", f"np.argmax({a}, axis=1)",
            f"np.argmin({a}, axis={self.one('1', '0')})", f"np.count_nonzero({a}, axis=1)", f"{a}.mean(axis=1)", f"np.mean({a}, axis=1)",
            f"np.prod({a}, axis=1)", f"{a}.argmax(axis=1)", f"np.median({a}, axis=1)", f"np.linalg.norm({a}, axis=1)", f"np.std({a}, axis=1)",
            f"np.add.reduce({a}, axis=1)", f"np.minimum.reduce({a}, axis=1)", f"{a}[:, 1]", f"np.minimum.reduce({a}, axis=1, dtype=float)",
            f"np.logical_and.reduce({a}, axis=1)", f"{a}.sum(1)", f"sum({a}[:, i] for i in range(n))",
        )  # fmt: skip

    def code(self) -> str:
        """Return statements that end with `out = ...`."""
        a = self.array
        if self.chance.random() < 0.55:
            return f"out = {a(self.chance.choice((1, 2, 2, 3)))}"
        lines = [self.one(
            lambda: f"z = np.zeros((len(f8), 3){self.one('', ', int', ', dtype=np.float32', ', bool', ', np.uint8')})",
            lambda: f"z = ({a(1)}).copy()", lambda: f"z = np.array({a(1)})", lambda: f"z = {a(1)} + 0", lambda: f"z = np.asarray({a(1)})",
            lambda: f"z = np.empty_like({a(1)}); z[...] = 1", lambda: f"z = ({a(1)}).astype(float)", lambda: "z = np.zeros((len(f8), 3)); v = z[:, 0]",
        )]  # fmt: skip
        lines += [self.writing() for _ in range(self.chance.choice((1, 2, 3)))]
        ends = ("out = z", "out = z", f"out = z + {a(1)}", "out = z.max(axis=1)[:, None] + f8", "out = z * b", "z[:, 2] = f8[:, 2]; out = z.sum(0) + f8")
        return "; ".join([*lines, self.one(*ends)])

    def writing(self) -> str:
        a, columns = self.array, ("z[:, 0]", "z[:, n - 2]", "z.T[1]", "z[..., -1]", "z.T[0]")
        target = self.one(*columns, "z[...]", "z[:, 1:]", "z[:]", "z[:, ::2]")
        value = f"({a(1)})[:, 1]" if target in columns else f"({a(1)})[:, :1]"
        return self.one(
            lambda: f"{target} = {value}", lambda: f"{target} = {self.number(1)}", lambda: f"z[{self.mask(1)}] = {self.number(1)}",
            lambda: f"{target} {self.one('+', '-', '*', '/')}= {self.one(value, self.number(1))}", lambda: "v = z[:, 1]",
            lambda: f"z {self.one('+', '-', '*', '/', '|', '&')}= {a(1)}", lambda: f"np.{self.one('add', 'maximum', 'multiply')}(z, {a(1)}, out=z)",
            lambda: f"np.copyto(z, {a(1)}, where={self.mask(1)})", lambda: f"v = z; v {self.one('+', '*')}= {self.number(1)}",
            lambda: f"w = z.reshape(len(f8), 3); w[:, 0] = {self.number(1)}", lambda: f"w = z.T.reshape(3, -1); w[0] = {self.number(1)}",
            lambda: f"z = z {self.one('+', '*')} {a(1)}", lambda: f"z[0] = {self.number(0)}", lambda: "z[:, 0], z[:, 1] = z[:, 1], z[:, 0]",
        )  # fmt: skip
