# ruff: noqa: E501 - tables
"""Texts that a person writes: overrides, components, formulas and arguments, and what reads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any


def _override(text: str) -> Any:
    from tailgate.training.train import load_config

    return load_config(None, text.split("\n"))


def _component(text: str) -> Any:
    from tailgate.core.registry import Spec

    family: Any = "attack" if text.startswith(("a ", "b")) else "defence"
    spec = Spec(family, text)
    spec.refuse_imports("text")
    return None if spec.sandboxed else spec.make()


def _formula(text: str) -> Any:
    from tailgate.trust.formula import parse

    return parse(text)


def _arguments(text: str) -> Any:
    import contextlib
    import io

    from tailgate.base.errors import InputError
    from tailgate.cli.command_line import _parser

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            return _parser().parse_args(text.split("\n"))
    except SystemExit as error:
        if error.code == 2 and said.getvalue().count("\n") == 1:
            raise InputError("arguments", text, "arguments") from None
        if error.code != 0:
            raise ValueError(f"exit code {error.code}: {said.getvalue()[:200]}") from None
        return None

OVERRIDES = (
    b"defence=kf\nthreat.budget=12\nsteps=2000", b"learner=cem\ncem.population=64\nname=a", b"environment.frames=4\nrivals=[none, jam]",
    b"defence=chi2_kf:eta=15\nwhite_box=[]\nteacher=best", b"gamma=0.99\ntensorboard=false\nout=runs\noutcome=crashed",
)  # fmt: skip

COMPONENTS = (
    b"chi2_kf:eta=15", b"composed:filter=rkf,detector=cusum,mitigation=reacquire", b"safe_state", b"burst_loss:probability=0.5", b"bias:value=[1, 2]",
    b"composed:filter=kf,detector=chi2,detector.eta=12", b"steered:defence=kf", b"policy:path=x.json", b"brake_kf",
)  # fmt: skip

FORMULAS = (b"G[0,60] gap > 2", b"G (attack -> F[0,0.6] applied <= -2)", b"(gap > 2 and not alarm) U[1,2.5] 2*speed - gap >= 0.5", b"F[0,end] true or false")

ARGUMENTS = (
    b"evaluate\n--suite\nquick-v0\n--defence\nkf\n--workers\n2\n--out\nrows.jsonl", b"leaderboard\nrun\nquick-v0\n--out\nboards", b"train\n--config\nquickstart\nsteps=5",
    b"trust\n--suite\nquick-v0\n--runs\n400\n--alpha\n0.05", b"calibrate\n--defence\ncusum_kf\n--hours\n1", b"replay\nrows.jsonl\n--out\nreplay", b"list",
    b"dose\njam\n--defence\nkf\n--scenario\nbraking-v0\n--doses\n1,2,3\n--limit\n0.1",
)  # fmt: skip


def _said(read: Callable[[str], Any]) -> Callable[[Path], Any]:
    return lambda folder: read((folder / "text").read_bytes().decode("utf-8", "surrogateescape"))


TEXTS = (  # name of the reader, valid texts, what reads a file of them, seconds that it may take
    ("overrides", OVERRIDES, _said(_override), 2.0),
    ("component texts", COMPONENTS, _said(_component), 1.0),
    ("formulas", FORMULAS, _said(_formula), 1.0),
    ("arguments", ARGUMENTS, _said(_arguments), 5.0),
)
