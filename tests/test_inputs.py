"""Whatever is given for a number of a registered component is refused by name, or plays a first episode of finite numbers."""

import dataclasses
import math
import types
import typing
import warnings

import pytest

from tailgate.agents.scripts.scripted import Inject, Script
from tailgate.base.errors import InputError, NotApplicable
from tailgate.cli import main
from tailgate.core.draws import keys
from tailgate.core.registry import PARTS, Spec, entries, make
from tailgate.core.scenario import load_scenario
from tailgate.core.schema import build, fields_of
from tailgate.core.threat import ThreatModel
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.play.trace import rollout

FLOATS = (-1.0, 0.0, math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300)
WHOLE = (-1, 0, 10**30, 1.5)
FILES = {"policy", "program", "rules", "zoo", "profile"}  # whose parameters are files
PLACES = ("stop-and-go-v0", "radar-following-v0", "thesis-ch5-v0", "platoon-braking-v0", "scalar-hold-v0", "thesis-ch6-v0", "thesis-ch4-literal-v0")
GUARDS = ("kf", "dkf", "cra")


def _kinds(hint):
    """The numbers in a type: float, int, or a tuple of one of them with its length, 0 where any is right."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _kinds(inner[0])
    if hint in (float, int):
        return [hint]
    if origin in (typing.Union, types.UnionType):
        return [kind for part in inner for kind in _kinds(part)]
    if origin is tuple and inner and (first := _kinds(inner[0])) and isinstance(first[0], type):
        return [(first[0], 0 if inner[-1] is Ellipsis else len(inner))]
    return []


def _bad(hint, default):
    """Values to try for a field."""
    for kind in _kinds(hint):
        if isinstance(kind, type):
            yield from FLOATS if kind is float else WHOLE
            continue
        some, size = FLOATS if kind[0] is float else WHOLE, kind[1] or (len(default) if isinstance(default, tuple) else 0) or 1
        yield from ([value] * size for value in some)
        if isinstance(default, tuple) and default:
            yield from ([value, *default[1:]] for value in some)
            yield list(default[::-1])


def cases(cls):
    hints, shared = typing.get_type_hints(cls, include_extras=True), fields_of(Script) if cls is not Inject else {}  # one plays these for all
    fields = [field for field in fields_of(cls).values() if field.name not in shared]
    return [(field.name, value) for field in fields for value in _bad(hints[field.name], field.default)]


def _plays(place, defence, attack, uses):
    """One short episode of each of two seeds; raises AssertionError where a number is not finite."""
    place = dataclasses.replace(place, horizon=min(place.horizon, 12)).with_threat(onset=4, end=None)
    trace = rollout(place.loop(defence, uses), attack, keys("train", (3, 4)))
    for name in ("truth", "estimate", "control", "wires"):
        if name in trace.signals:
            assert not trace.signals[name].size or abs(trace.signals[name]).max() < math.inf, name


def _host(family, name):
    """A function that plays a component with given parameters, in the first published scenario in which it has a meaning."""
    cls = entries(family)[name].cls
    for scenario in PLACES:
        place = load_scenario(scenario)
        for guard in {"defence": (name,), "filter": ("composed",), "detector": ("composed",), "mitigation": ("composed",)}.get(family, GUARDS):
            uses = entries("defence")[guard].uses

            def run(params, place=place, guard=guard, uses=uses):
                defence, attack = None if family == "defence" else make("defence", guard), make("attack", "none")
                if family in ("defence", *PARTS):
                    defence = make(family, name, **params) if family == "defence" else make("defence", guard, **{family: {"name": name, **params}})
                    attack = make("attack", "fdi_gaussian")
                elif family == "attack":
                    attack = make(family, name, **params)
                else:
                    held = getattr(place, family)
                    kept = {f.name: getattr(held, f.name) for f in dataclasses.fields(held)} if type(held) is cls else {}
                    place = dataclasses.replace(place, **{family: make(family, name, **(kept | params))})
                knowledge = {"knowledge": entries("attack")[name].knowledge} if family == "attack" else {}
                _plays(place.with_threat(**knowledge), defence, attack, uses)

            if family in ("plant", "sensor") and type(getattr(place, family)) is not cls:
                continue
            try:
                run({})
            except InputError:
                continue
            return run
    return None


FAMILIES = ("defence", *PARTS, "attack", "plant", "sensor", "controller", "manoeuvre")
NAMES = [(family, name) for family in FAMILIES for name, entry in entries(family).items() if entry.built_in and name not in FILES and cases(entry.cls)]


@pytest.mark.thin(12)
@pytest.mark.parametrize(("family", "name"), NAMES)
def test_a_bad_number_is_refused_by_name_or_harmless(family, name):
    """Negative, zero, NaN, infinite, huge, tiny and reversed values of every numeric field of every registered component."""
    cls, run = entries(family)[name].cls, _host(family, name)
    for field, value in cases(cls):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                if run is None:  # no published scenario in which it has a meaning as it is: its construction alone
                    make(family, name, **{field: value})
                else:
                    run({field: value})
            except NotApplicable:
                continue
            except InputError as error:
                assert "\n" not in str(error) and "defence output" not in str(error), (field, value, str(error))
            except Exception as error:
                raise AssertionError(f"{family} {name}.{field} = {value!r}: {type(error).__name__}: {error}") from error


@pytest.mark.parametrize(("field", "value"), [
    ("budget", 10**30), ("duration", 10**30), ("cooldown", 10**30), ("onset", 10**30), ("end", 10**30), ("memory", 10**30), ("fdi_bound", 1e300),
    ("actuator_bound", 1e300), ("jam_power", 1e300), ("delay_bound", 1e300), ("reaction", 1e300), ("jam_range", [-1e300, 1e300]), ("jam_range", [3.0, 1.0]),
    ("jam_range", [math.nan, 1.0]), ("agents", [10**30]),
])  # fmt: skip
def test_numbers_of_a_threat_model_have_limits(field, value):
    with pytest.raises(InputError, match=rf"threat_model\.{field}.*expected"):
        build(ThreatModel, {field: value}, "threat_model")


@pytest.mark.parametrize(("family", "name", "params", "said"), [
    ("plant", "car_following", {"gap": -3}, r"plant car_following\.gap: got -3; expected greater than 0 \[m\]"),
    ("plant", "car_following", {"initial_sd": [0, -2.0, 0]}, r"initial_sd\.1: got -2\.0; expected greater than or equal to 0 \[m/s\]"),
    ("plant", "car_following", {"initial_sd": [20.0, 0, 0]}, r"car_following\.gap: got 85\.5; expected more than 6 times"),
    ("plant", "car_following", {"rear_reaction": 5000.0}, r"rear_reaction: got 5000\.0; expected at most 10000 steps"),
    ("plant", "platoon", {"gap": 2.0}, r"plant platoon\.gap: got 2\.0; expected more than gap_range"),
    ("plant", "platoon_linear", {"gap_sd": 20.0}, r"gap: got 65\.0; expected more than gap_range \+ 6 gap_sd \(122\)"),
    ("plant", "sensor_network", {"agents": 1000, "states": 1000}, r"plant sensor_network\.states"),
    ("controller", "acc", {"accel_min": 3.0}, "accel_min, accel_max.*smaller first"), ("controller", "cacc", {"accel_max": -9.0}, "accel_min, accel_max"),
    ("controller", "acc_radar", {"accel_max": -9.0}, "accel_min, accel_max"), ("sensor", "fmcw_radar", {"reach": [9.0, 9.0]}, "reach.*two different"),
])  # fmt: skip
def test_what_does_not_go_together_is_refused(family, name, params, said):
    """Cars that begin in a collision, limits in the wrong order, memories that are too long."""
    with pytest.raises(InputError, match=said):
        make(family, name, **params)


@pytest.mark.parametrize("text", ["kf:gain=steady", "dkf", "centralised_kf", "rkf", "trimmed_consensus", "norm_resilient"])
def test_a_filter_that_divides_by_the_noise_refuses_a_sensor_without(text):
    """Zero noise is legal for a sensor: a filter with a varying gain plays it."""
    place = load_scenario("stop-and-go-v0")
    place = dataclasses.replace(place, sensor=make("sensor", "odometry", noise_var=[0.0, 0.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(NotApplicable, match=r"noise variance: got \[0\.0, 0\.0\]"):
            place.loop(Spec("defence", text).make())
        _plays(place, make("defence", "kf"), make("attack", "none"), ())


def test_no_reading_may_be_certain_altogether():
    """Without noise of sensor and process no filter has a gain."""
    place = load_scenario("stop-and-go-v0")
    plant = dataclasses.replace(place.plant, process_var=(0.0, 0.0, 0.0))
    place = dataclasses.replace(place, plant=plant, sensor=make("sensor", "odometry", noise_var=[0.0, 0.0]))
    with pytest.raises(NotApplicable, match="variance of a reading"):
        place.loop(make("defence", "kf"))


@pytest.mark.parametrize("gamma", [1.5, 0.0, -0.1, float("nan")])
def test_a_discount_is_within_its_range(gamma):
    with pytest.raises(InputError, match=r"reward\.gamma"):
        Seat.make(gamma=gamma)


def test_an_attack_whose_commands_are_refused_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", "--scenario", "thesis-ch4-v0", "--dose", "none", "--seeds", "2", "--threat", "kinds=[fdi]", "--defence", "kf", "--attack"]
    assert main([*words, "fdi_then_jam:inject=20"]) == 0
    half = capsys.readouterr().err
    assert "fdi_then_jam:inject=20 in thesis-ch4-v0: " in half and "of its commands are refused" in half
    assert main([*words, "fdi"]) == 0 and "refused" not in capsys.readouterr().err
