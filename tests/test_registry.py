"""Names to components: specs as text, nearest names, plug-ins, and data that is the same for the same parameters."""

import dataclasses
import importlib
import json
import pickle
import pydoc
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import tailgate
from tailgate.base import own_modules
from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.base.lazy import components
from tailgate.core import Positive, param, registry
from tailgate.core.foreign import with_place
from tailgate.core.registry import Entry, Spec, entries, find, make_from, put, register
from tailgate.core.schema import as_data, build, canonical, override, read_yaml, scalar
from tailgate.estimators import GatedKalman, Kalman
from tailgate.training.selfplay import GameConfig
from tailgate.training.train import TrainConfig

PLUGIN = """
    from dataclasses import dataclass
    from tailgate.estimators import Kalman

    NUMBER = 3

    @dataclass(frozen=True)
    class Mine(Kalman):
        '''A plug-in.'''
        uses = ("measurements", "v2v")
        version = 4
        reference = "nobody"
        gain: float = 2.0
        names: tuple[str, ...] = ()
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """A module of somebody else on the path."""
    (tmp_path / "their_defence.py").write_text(textwrap.dedent(PLUGIN))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "their_defence"
    sys.modules.pop("their_defence", None)


@pytest.fixture
def shelf(monkeypatch):
    """A registry that forgets what a test put in, but not modules that it was the first to import."""
    before = registry._entries
    with monkeypatch.context() as patch:
        patch.setattr(registry, "_entries", {family: dict(known) for family, known in before.items()})
        patch.setattr(registry, "_plugins_loaded", set())
        yield registry
        for family, held in registry._entries.items():
            before[family].update({name: entry for name, entry in held.items() if entry.built_in})


SPECS = [
    ("defence", "kf", Kalman()), ("defence", "chi2_kf", GatedKalman(20.0)), ("defence", "chi2_kf:eta=7", GatedKalman(7.0)),
    ("defence", "chi2_kf:eta=1e12", GatedKalman(1e12)), ("defence", "chi2_kf: eta = 7.5", GatedKalman(7.5)),
    ("defence", "tailgate.estimators:GatedKalman", GatedKalman(20.0)),
    ("defence", "tailgate.estimators:GatedKalman:eta=3", GatedKalman(3.0)),
    ("attack", "fdi:value=-4,length=10", tailgate.make_attack("fdi", value=-4.0, length=10)),
    ("attack", "fdi:targets=[position,velocity],value=2", tailgate.make_attack("fdi", targets=("position", "velocity"), value=2.0)),
    ("attack", "fdi:targets=[velocity]", tailgate.make_attack("fdi", targets=("velocity",))),
    ("attack", "dos_hold:fresh=true,length=none", tailgate.make_attack("dos_hold", fresh=True)),
]  # fmt: skip


@pytest.mark.parametrize("family, text, want", SPECS)
def test_specs(family, text, want):
    """Text gives the component with these parameters, equal to the one made in Python."""
    made = Spec(family, text).make()
    assert type(made) is type(want) and made == want and canonical(made) == canonical(want)


def test_somebody_elses_class(plugin):
    """module:Class, with parameters; uses, version and reference come from the class; its file's digest is known."""
    made = Spec("defence", f"{plugin}:Mine:gain=3,names=[a,b]").make()
    assert (made.gain, made.names) == (3.0, ("a", "b"))
    entry = Spec("defence", f"{plugin}:Mine").entry
    assert (entry.name, entry.uses, entry.version, entry.reference) == (f"{plugin}:Mine", ("measurements", "v2v"), 4, "nobody")
    assert len(Spec("defence", f"{plugin}:Mine").digest) == 64 and Spec("defence", "kf").digest == ""


BAD = [
    ("defence", "mydefence.py", "a class of that file, as mydefence:Class"), ("attack", "myattack.py", "as myattack:Class"),
    ("defence", "chi2_fk", r"defence: got 'chi2_fk'; expected one of these \(did you mean 'chi2_kf'\?\): .*kf"),
    ("attack", "fdi_rampp", r"attack.*did you mean 'fdi_ramp'"), ("defence", "", r"defence: got ''; expected one of"),
    ("defence", "chi2_kf:etta=3", r"chi2_kf: unknown field: got 'etta'.*did you mean 'eta'"),
    ("defence", "chi2_kf:eta=big", r"chi2_kf\.eta: got 'big'; expected"), ("defence", "chi2_kf:eta=-1", r"chi2_kf\.eta: got -1"),
    ("defence", "chi2_kf:eta=nan", r"chi2_kf\.eta: got nan"), ("defence", "chi2_kf:eta=3,4", r"name:key=value,key=value"),
    ("defence", "no_such_module:Thing", r"importable module"), ("defence", "tailgate.estimators:Nothing", r"a class that module"),
    ("defence", "their_defence:Mien", r"a class that module their_defence defines \(did you mean 'Mine'\?\): Mine$"),
    ("defence", "Mine", r"'Mine'; expected a class of yours as module:Mine, or one of"), ("attack", "Creep", r"a class of yours as module:Creep"),
    ("defence", "their_defence:NUMBER", r"expected a class"), ("defence", "their_defence:Mine:gain=x", r"gain: got 'x'"),
    ("defence", ":Mine", r"defence: got ':Mine'"), ("defence", ".estimators:Kalman", r"defence: got '\.estimators:Kalman'"),
    ("attack", "nowhere.json:speed=1", r"unknown field: got 'speed'"),
]  # fmt: skip


def test_a_module_that_is_not_there_is_looked_for_in_the_working_directory(tmp_path, monkeypatch):
    """The error names the folder, and a file there whose name is nearly the same."""
    (tmp_path / "mydefence.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(own_modules, "_wanted", False)  # as no command has been run in this process
    for there, words in (("", rf"working directory {tmp_path} and the installed packages \(did you mean 'mydefence'\?\)$"), (None, r"looked for in the installed packages$")):
        with monkeypatch.context() as patch:
            patch.setattr(sys, "path", [path for path in sys.path if path and Path(path).resolve() != tmp_path] + ([there] if there is not None else []))
            with pytest.raises(InputError, match=words):
                Spec("defence", "mydefense:Mine").make()


def test_a_plant_of_a_file_is_registered_in_python():
    with pytest.raises(InputError, match=r"an entry point of the group tailgate.plants, or in Python one that @register\('plant', NAME\) has given: a file imports"):
        make_from("plant", "myplant:Mine", "scenario s.plant")


@pytest.mark.parametrize("family, text, message", BAD)
def test_bad_specs(family, text, message, plugin):
    """One line with the field, the value and what was expected, the nearest name included."""
    with pytest.raises(InputError, match=message) as caught:
        Spec(family, text).make()
    assert "\n" not in str(caught.value)


def test_configuration_files_name_registered_components_only(plugin):
    """A class to import is refused where a file names it; a mapping needs a name."""
    with pytest.raises(InputError, match="imports nothing"):
        Spec("defence", f"{plugin}:Mine").refuse_imports("suite x")
    with pytest.raises(InputError, match=r"a program \(YAML\) or a policy \(JSON\)"):  # no sandbox plays an attack
        Spec("attack", f"{plugin}:Mine").refuse_imports("suite x")
    Spec("defence", "chi2_kf:eta=3").refuse_imports("suite x")
    with pytest.raises(InputError, match="defence"):
        make_from("defence", f"{plugin}:Mine", "suite x")
    with pytest.raises(InputError, match="a name, or a mapping"):
        make_from("defence", {"eta": 3}, "suite x")
    assert make_from("defence", {"name": "chi2_kf", "eta": 3}, "suite x") == GatedKalman(3.0)


def test_reusing_a_name_is_an_error(shelf):
    """Another class under a name that is taken is refused; the same class again is not."""

    @dataclass(frozen=True)
    class Other(Kalman):
        """Another."""

    with pytest.raises(InputError, match=r"defence name: got 'kf'; expected a name that is not taken"):
        register("defence", "kf")(Other)
    assert find("defence", "kf").cls is Kalman
    put(find("defence", "kf"))
    assert register("defence", "kf_of_somebody")(Other) is Other and "kf_of_somebody" in tailgate.list_defences()
    with pytest.raises(InputError, match=r"uses.*'sonar'"):
        put(Entry("defence", "x", Other, uses=("sonar",)))


def _points(monkeypatch, group, **named):
    asked = []

    def entry_points(group=None):
        asked.append(group)
        return [EntryPoint(name, value, group) for name, value in named.items()] if group == target else []

    target = group
    monkeypatch.setattr(registry, "entry_points", entry_points)
    return asked


def test_plug_ins_by_entry_point(shelf, plugin, monkeypatch):
    """Entry points of the group are loaded once, listed and made like built-in ones."""
    asked = _points(monkeypatch, "tailgate.estimators", mine=f"{plugin}:Mine")
    assert "mine" in tailgate.list_defences() and tailgate.make_defence("mine", gain=5).gain == 5.0
    assert find("defence", "mine").card()["uses"] == ["measurements", "v2v"] and find("defence", "mine").version == 4
    assert Spec("defence", "mine:gain=6").make().gain == 6.0 and "mine" not in tailgate.list_attacks()
    assert asked == ["tailgate.estimators", "tailgate.agents"]
    with pytest.raises(InputError, match="did you mean 'mine'"):
        tailgate.make_defence("minee")


def test_a_plug_in_is_seen_as_a_part_too(shelf, plugin, monkeypatch):
    """Rows that name it run somebody's code, and another file makes other rows."""
    registry._plugged.cache_clear()
    _points(monkeypatch, "tailgate.detectors", mine=f"{plugin}:Mine")
    spec = Spec("defence", "composed:filter=kf,detector=mine")
    assert spec.foreign and len(spec.digest) == 64 and not Spec("defence", "composed:filter=kf,detector=cusum").foreign
    registry._plugged.cache_clear()


def test_a_plug_in_without_the_methods_of_its_family_is_a_warning(shelf, plugin, monkeypatch):
    _points(monkeypatch, "tailgate.plants", mine=f"{plugin}:Mine")
    with pytest.warns(UserWarning, match=r"'mine' of tailgate.plants cannot be loaded: .*expected a class with model, prepare"):
        assert "mine" not in entries("plant")


def test_a_plug_in_cannot_take_a_built_in_name(shelf, plugin, monkeypatch):
    """The clash is reported whenever the family is asked for, and the built-in one stays."""
    _points(monkeypatch, "tailgate.estimators", kf=f"{plugin}:Mine")
    for _ in range(2):
        with pytest.raises(InputError, match=r"'kf'.*not taken"):
            tailgate.list_defences()
    assert registry._entries["defence"]["kf"].cls is Kalman


def test_cards_are_json():
    """Every entry's card is JSON with its parameters' defaults and sentences."""
    for family in ("defence", "attack", "plant", "sensor", "controller", "manoeuvre"):
        for name, entry in entries(family).items():
            card = entry.card()
            assert json.loads(json.dumps(card)) == card and card["name"] == name and card["summary"]
            assert all(p["doc"] for p in card["parameters"].values())
    assert find("defence", "chi2_kf").card()["parameters"]["eta"]["default"] == 20.0


@dataclass(frozen=True)
class Sample:
    """Parameters of every type."""

    b: Positive = param(1.0, "a number [-]")
    a: tuple[int, ...] = param((1, 2), "a list")
    c: dict[str, float] = dataclasses.field(default_factory=lambda: {"y": 1.0, "x": 2.0})
    path: Path | None = param(None, "a file")


def test_canonical_text_is_stable(tmp_path):
    """Sorted keys, every default written out, files by their content and not by their place."""
    assert canonical(Sample()) == f'{{"a":[1,2],"b":1.0,"c":{{"x":2.0,"y":1.0}},"class":"{Sample.__module__}.Sample","path":null}}'
    assert canonical(Sample(c={"x": 2.0, "y": 1.0})) == canonical(Sample()) != canonical(Sample(b=2.0))
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "f.csv").write_text("t,v\n")
    one, two = (canonical(Sample(path=tmp_path / folder / "f.csv")) for folder in ("one", "two"))
    assert one == two and str(tmp_path) not in one
    (tmp_path / "two" / "f.csv").write_text("t,v\n0,1\n")
    assert canonical(Sample(path=tmp_path / "two" / "f.csv")) != one
    assert as_data(GatedKalman(3.0)) == {"class": "tailgate.estimators.chi_square.GatedKalman", "eta": 3.0, "gain": "varying"}


def test_built_values_have_the_declared_types():
    """An int for a float, a list for a tuple: the same canonical text as in Python; unknown and bad fields are named."""
    assert canonical(build(Sample, {"b": 3, "a": [4]}, "sample")) == canonical(Sample(b=3.0, a=(4,)))
    bad = {"bb": r"sample: unknown field: got 'bb'", "b": r"sample\.b: got 0", "a": r"sample\.a: got 0", "c": r"sample\.c: got 0"}
    for data, message in (({name: 0}, message) for name, message in bad.items()):
        with pytest.raises(InputError, match=message):
            build(Sample, data, "sample")


@given(st.one_of(st.integers(-(10**9), 10**9), st.floats(allow_nan=False, allow_infinity=False), st.booleans()))
def test_scalars_survive_their_text(value):
    """A number written on the command line is read back."""
    assert scalar(repr(value)) == value and scalar(json.dumps(value)) == value


@pytest.mark.parametrize(
    "text, value", [("none", None), ("null", None), ("1e5", 1e5), ("[1, 2]", [1, 2]), ("[a,b]", ["a", "b"]), ("word", "word"), ("", None)]
)
def test_scalar_forms(text, value):
    """YAML scalars and flow lists, 1e5 as a number."""
    assert scalar(text) == value


def test_overrides():
    """Dotted assignments change nested fields of a copy; anything else is refused."""
    data, put_in = {"a": {"b": 1}, "c": 2}, partial(override, cls=TrainConfig)
    assert put_in(data, ["defence=none", "teacher=none"])["defence"] == "none" and put_in(data, ["teacher=none"])["teacher"] is None
    assert put_in(data, ["a.b=5", "d.e=[1]", "c=x=y"]) == {"a": {"b": 5}, "c": "x=y", "d": {"e": [1]}}
    assert data == {"a": {"b": 1}, "c": 2}
    for bad in ("c", "=3", "c.d=1"):
        with pytest.raises(InputError, match="override"):
            put_in(data, [bad])


@pytest.mark.parametrize("text", ["nan", "5", "1e5", "true", "none", "2026-01-01"])
def test_a_text_field_takes_any_word(text: str) -> None:
    assert override({}, [f"name={text}"], TrainConfig)["name"] == override({}, [f'name="{text}"'], GameConfig)["name"] == text
    assert override({}, ["steps=5", "name=[5]"], TrainConfig) == {"steps": 5, "name": [5]}


UNSAFE = "a: !!python/object/apply:os.getcwd []"


@pytest.mark.parametrize("text, message", [("a: [", "valid YAML"), ("- 1", "mapping"), (UNSAFE, "valid YAML")])
def test_yaml_is_read_safely(text, message, tmp_path):
    """Broken YAML, a list and a tag that would run code are input errors; so is a missing file."""
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        read_yaml(tmp_path / "x.yaml", "suite")
    with pytest.raises(InputError, match=r"suite: got .*missing\.yaml.*readable"):
        read_yaml(tmp_path / "missing.yaml", "suite")


@pytest.mark.parametrize("cls", [InputError, NotApplicable])
def test_errors_cross_process_borders(cls):
    """An error keeps its type, field, value and expectation through pickle; long values are cut; one line always."""
    error = pickle.loads(pickle.dumps(cls("field", 3, "four")))
    assert type(error) is cls and (error.field, error.value, error.expected) == ("field", 3, "four")
    assert str(error) == "field: got 3; expected four" and isinstance(error, ValueError)
    assert len(str(InputError("f", "x" * 1000, "y"))) < 150
    assert str(unknown("f", "ab", [])).endswith("no name: none exists")


@pytest.mark.parametrize("text", ["chi2_kf:eta", "chi2_kf:eta 3", "chi2_kf:"])
def test_a_parameter_without_a_value_is_no_module(text):
    """The name is registered, so what follows it should have been key=value."""
    with pytest.raises(InputError, match="chi2_kf:key=value"):
        Spec("defence", text).make()


def test_every_built_in_component_is_found_in_its_own_module():
    """By the text of the module, so that no other has to be imported; and a package gives what it says."""
    for family, package in registry._MODULES.items():
        for name, entry in entries(family).items():
            if entry.built_in:
                assert components(package)[family, name] == entry.cls.__module__
    for package in map(importlib.import_module, set(registry._MODULES.values())):
        assert all(hasattr(package, name) for name in package.__all__)
        with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
            _ = package.nothing


FOREIGN = """
import json
import numpy as np
from dataclasses import dataclass
from tailgate.estimators.filters.kalman import Kalman

@dataclass(frozen=True)
class Seeded(Kalman):
    def step(self, *arguments):
        np.random.RandomState(-1)  # raised in compiled code

@dataclass(frozen=True)
class Library(Kalman):
    def step(self, *arguments):
        json.loads("{")

@dataclass(frozen=True)
class Early(Kalman):
    def __post_init__(self):
        {}["x"]

class Plain:
    def __init__(self):
        self.x = np.zeros(3).reshape(2)
"""


@pytest.mark.parametrize(("name", "line"), [("Seeded", 10), ("Library", 15)])
def test_an_error_names_the_last_line_of_its_users_own_file(name, line, tmp_path, monkeypatch):
    """Neither a library's line nor a compiled one, whose file is not there."""
    (tmp_path / "foreign_lines.py").write_text(FOREIGN)
    monkeypatch.syspath_prepend(tmp_path)
    defence = Spec("defence", f"foreign_lines:{name}").make()
    with pytest.raises(ValueError) as caught:
        defence.step(None, None, None, None, None)
    assert with_place(caught.value).endswith(f"(foreign_lines.py, line {line})")


@pytest.mark.parametrize(("name", "line"), [("Early", 20), ("Plain", 24)])
def test_a_class_that_cannot_be_made_is_refused_with_its_line(name, line, tmp_path, monkeypatch):
    (tmp_path / "foreign_lines.py").write_text(FOREIGN)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=rf"a class that can be made \(\w+Error: .*\(foreign_lines\.py, line {line}\)\)"):
        Spec("defence", f"foreign_lines:{name}").make()


@pytest.mark.thin(3)
@pytest.mark.parametrize("heavy", ["torch", "cvxpy", "highway_env"])
def test_components_are_listed_without_the_extras(heavy):
    """The light install has none of them; only the learners need torch."""
    code = f"""
import sys
sys.modules[{heavy!r}] = None
from tailgate.core import registry
for family in registry._MODULES:
    if {heavy!r} != "torch" or family != "learner":
        assert registry.entries(family), family
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_help_of_the_package_lists_what_is_imported_on_first_use():
    """Its example plays."""
    text = pydoc.plain(pydoc.render_doc(tailgate))
    functions = text[text.index("\nFUNCTIONS") :]
    assert all(f"\n    {name}(" in functions for name in ("evaluate", "make_defence", "list_attacks", "per_episode"))
    held: dict = {}
    exec(textwrap.dedent(tailgate.__doc__.partition("Example::")[2]), held)
    assert held["env"].spec.id == "tailgate/CarFollowing-v1" and len(held["rows"]) == 2
