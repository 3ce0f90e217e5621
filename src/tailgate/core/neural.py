"""A small neural network, computed in float64 with a fixed order of summation, and its files: safetensors with a JSON header.

No sum depends on the batch, and so no trace does. Reading a file executes nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tailgate import num
from tailgate.base.errors import InputError, said
from tailgate.base.files import write_atomic, write_json
from tailgate.base.reading import TENSORS, load_json, read_bytes, tensors_of
from tailgate.core.nouns import Array
from tailgate.core.schema import build


class Trained(Protocol):
    """The header of a file of trained weights."""

    @property
    def tensors(self) -> str: ...
    @property
    def sha256(self) -> str: ...


T = TypeVar("T", bound=Trained)


class Memory(NamedTuple):
    """The memory of an LSTM, (B, H) each."""

    hidden: Array
    cell: Array


@dataclass(frozen=True, eq=False)
class Lstm:
    """One layer of long short-term memory (Hochreiter and Schmidhuber 1997; forget gate: Gers et al. 2000).

    weight (d + H, 4 H) for the input above the hidden state, bias (4 H,); columns: input gate, forget gate, cell, output gate.
    """

    weight: Array
    bias: Array

    @property
    def size(self) -> int:
        """H, the width of the memory."""
        return len(self.bias) // 4

    def blank(self, batch: int) -> Memory:
        """Return the memory of episodes that begin."""
        return Memory(np.zeros((batch, self.size)), np.zeros((batch, self.size)))

    def __call__(self, observation: Array, memory: Memory) -> Memory:
        """Return the memory after an observation (B, d) float32 and the memory before it."""
        read = np.concatenate([np.asarray(observation, np.float64), memory.hidden], axis=1)
        gates = num.dense(read, self.weight, self.bias, squash=False)
        admit, keep, new, show = (np.ascontiguousarray(gates[:, n * self.size : (n + 1) * self.size]) for n in range(4))
        cell = _sigmoid(keep) * memory.cell + _sigmoid(admit) * num.tanh(new)
        return Memory(_sigmoid(show) * num.tanh(cell), cell)


def _sigmoid(x: Array) -> Array:
    return np.asarray(0.5 + 0.5 * num.tanh(0.5 * x))


@dataclass(frozen=True, eq=False)
class Network:
    """weights[l] (i, o) and biases[l] (o,), tanh between layers; log_std (values,) for continuous actions.

    With an `lstm` the perceptron reads its hidden state instead of the observation. `squashed`: tanh after the last layer as well.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    log_std: Array | None = None
    lstm: Lstm | None = None
    squashed: bool = False

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return len(self.biases[-1])

    def __call__(self, observation: Array) -> Array:
        """Return the output (B, o) for an input (B, d): logits or values of discrete actions, or the mean of a continuous action."""
        x: Array = np.asarray(observation, np.float64)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = num.dense(x, weight, bias, squash=self.squashed or i + 1 < len(self.weights))
        return x


def read_trained(kind: type[T], form: str, path: Path, field: str, where: str) -> tuple[T, dict[str, Array]]:
    """Return the header and the tensors of a trained policy or defender.

    kind: the header's dataclass. Reads data and runs nothing. Raises InputError, which names `where`, the field and its value, for any
    other content.
    """
    try:
        data = load_json(path, strict=False)
    except OSError as error:
        raise InputError(field, str(path), f"a readable file ({error.strerror})") from None
    except ValueError as error:
        raise InputError(where, str(path), f"valid JSON ({error})") from None
    if not isinstance(data, dict) or data.get("format") != form:
        shown = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise InputError(where, shown, f"a JSON object of format {form!r}")
    header = build(kind, data, where)
    if not header.tensors or Path(header.tensors).name != header.tensors:
        raise InputError(f"{where}.tensors", header.tensors, "the name of a file in the folder of the JSON file")
    try:
        blob = read_bytes(path.with_name(header.tensors), TENSORS)
    except OSError as error:
        raise InputError(f"{where}.tensors", header.tensors, f"a readable file ({said(error)})") from None
    if hashlib.sha256(blob).hexdigest() != header.sha256:
        raise InputError(f"{where}.sha256", header.sha256, f"the digest of {header.tensors}: the file is damaged or another one")
    try:
        return header, tensors_of(blob, load_tensors)[0]
    except ValueError as error:
        raise InputError(f"{where}.tensors", header.tensors, f"a safetensors file ({error})") from None


def write_trained(path: Path, form: str, tensors: Mapping[str, Array], layers: int, header: dict[str, Any]) -> Path:
    """Write PATH.safetensors and PATH.json, as `read_trained` reads them; return the latter. header: what it holds besides."""
    blob, file = save_tensors({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}), path.with_suffix(".safetensors")
    data = {"format": form, "tensors": file.name, "sha256": hashlib.sha256(blob).hexdigest(), "layers": layers}
    write_atomic(file, blob)
    write_json(path.with_suffix(".json"), data | header)
    return path.with_suffix(".json")


def layers_of(weights: Sequence[Array], biases: Sequence[Array]) -> dict[str, Array]:
    """Return the tensors of a perceptron by name, as `perceptron` reads them."""
    return {f"layer{i}.{name}": part[i] for i in range(len(weights)) for name, part in (("weight", weights), ("bias", biases))}


def perceptron(tensors: dict[str, Array], layers: int, width: int, where: str) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return weights and biases of the layers in a file.

    Raise InputError where one is missing, not finite, or does not fit the one before.
    """
    weights, biases = [], []
    for i in range(layers):
        weight, bias = pair(tensors, f"layer{i}", where, f"{width}, outputs", partial(_takes, width))
        weights.append(weight)
        biases.append(bias)
        width = len(bias)
    return tuple(weights), tuple(biases)


def _takes(width: int, weight: Array) -> bool:
    return bool(weight.shape[0] == width)


def pair(tensors: dict[str, Array], name: str, where: str, inputs: str, fits: Callable[[Array], bool]) -> tuple[Array, Array]:
    """Return weight and bias of one layer in a file; raise InputError where one is missing, not finite, or of another shape."""
    weight, bias = tensors.get(f"{name}.weight"), tensors.get(f"{name}.bias")
    if (
        weight is None or bias is None or weight.ndim != 2 or not fits(weight) or bias.shape != weight.shape[1:]
        or not all(x.dtype.kind == "f" and np.isfinite(x).all() for x in (weight, bias))
    ):  # fmt: skip
        shown = None if weight is None else weight.shape
        raise InputError(f"{where}: {name}", shown, f"finite weights ({inputs}) and as many biases")
    return np.ascontiguousarray(weight, np.float64), np.ascontiguousarray(bias, np.float64)
