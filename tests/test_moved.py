"""Import paths of earlier releases lead to the modules of today."""

import importlib
import sys

import pytest

from tailgate.moved import MOVED, PROMOTED, now


def test_an_earlier_path_is_the_module_of_today() -> None:
    for name, today in MOVED.items():
        sys.modules.pop(name, None)
        with pytest.warns(DeprecationWarning, match=f"{name} is now {today}"):
            module = importlib.import_module(name)
        assert module is importlib.import_module(today) and module.__name__ == module.__spec__.name == today


def test_modules_of_a_moved_folder_are_found() -> None:
    sys.modules.pop("tailgate.reproduce.claims", None)
    with pytest.warns(DeprecationWarning, match=r"tailgate\.reproduce\.claims is now tailgate\.thesis\.claims"):
        claims = importlib.import_module("tailgate.reproduce.claims")
    assert claims is importlib.import_module("tailgate.thesis.claims")


@pytest.mark.parametrize("name", sorted(PROMOTED))
def test_a_folder_gives_what_the_module_of_its_name_defined(name: str) -> None:
    folder, module = importlib.import_module(f"tailgate.{name}"), importlib.import_module(f"tailgate.{PROMOTED[name]}")
    kind = next(held for held in vars(module).values() if isinstance(held, type) and held.__module__ == module.__name__)
    with pytest.warns(DeprecationWarning, match=f"{name}.{kind.__name__} is now {module.__name__}"):
        assert getattr(folder, kind.__name__) is kind
    with pytest.raises(AttributeError):
        _ = folder.nothing


def test_what_never_was_is_not_found() -> None:
    assert now("tailgate.nothing") == "" == now("tailgate.core.threat")
    with pytest.raises(ModuleNotFoundError, match=r"tailgate\.nothing"):
        importlib.import_module("tailgate.nothing")
