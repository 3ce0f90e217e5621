"""Classes of others that say odd things of themselves."""

import sys

import pytest

from tailgate.base.errors import InputError
from tailgate.core import registry
from tailgate.core.registry import Spec

from . import test_registry
from .test_registry import _points

shelf = test_registry.shelf


@pytest.mark.parametrize(("attribute", "words"), [
    ('uses = "odometry"', "uses: got 'odometry'; expected several names"), ('uses = ("odometri",)', "did you mean 'odometry'"),
    ("uses = 5", "uses: got 5"), ('version = "a"', "version: got 'a'; expected a whole number"),
])  # fmt: skip
def test_what_a_class_says_of_itself_is_checked(attribute, words, tmp_path, monkeypatch, shelf):
    """Also that of a plug-in, which then stops nobody who does not use it."""
    (tmp_path / "odd_defence.py").write_text(
        f"class Odd:\n    {attribute}\n    def prepare(self, model): pass\n    def start(self, plan, prior): pass\n    def step(self, *given): pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("odd_defence", None)
    _points(monkeypatch, "tailgate.estimators", odd="odd_defence:Odd")
    with pytest.warns(UserWarning, match="plug-in 'odd'"):
        assert "kf" in registry.entries("defence") and "odd" not in registry.entries("defence")
    with pytest.raises(InputError, match=words):
        _ = Spec("defence", "odd_defence:Odd").entry
