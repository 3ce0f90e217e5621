"""Shared builders: short scenarios, rollouts, linear models, and equality to the last bit."""

import contextlib
import dataclasses
import json
import os
import shutil
import sys
from collections import Counter
from itertools import combinations
from typing import get_args

import numpy as np
import pytest
from hypothesis import settings

import tailgate
from tailgate.base.errors import NotApplicable
from tailgate.base.pytree import leaves
from tailgate.core import Model
from tailgate.core.draws import keys
from tailgate.core.kinds import KindName
from tailgate.core.registry import entries
from tailgate.core.scenario import load_scenario
from tailgate.play import trace
from tailgate.play.trace import rollout

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # hundreds of commands are started: each would compile the package
sys.dont_write_bytecode = False
os.environ.setdefault("TAILGATE_LLVM", "0")  # code is compiled for a few steps only; no bit depends on it

settings.register_profile("steady", deadline=None, derandomize=True)  # machines differ in speed, and a suite shall repeat
settings.load_profile("steady")


def pytest_addoption(parser):
    parser.addoption("--long", action="store_true", help="also the tests that take a minute each: whole chapters, trainings, searches")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--long"):
        return
    turns: Counter[str] = Counter()
    kept, left = [], []
    for item in items:
        thin, name = item.get_closest_marker("thin"), item.nodeid.partition("[")[0]
        turns[name] += 1
        (left if item.get_closest_marker("long") or (thin and (turns[name] - 1) % thin.args[0]) else kept).append(item)
    config.hook.pytest_deselected(items=left)
    items[:] = kept


def pytest_runtest_setup(item):
    """Reset the generator RNG of a test's module, so that no test depends on those before it."""
    rng = getattr(item.module, "RNG", None)
    if isinstance(rng, np.random.Generator):
        rng.bit_generator.state = np.random.PCG64(rng.bit_generator.seed_seq).state


def _same_bits(a, b):
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()


@pytest.fixture(scope="session")
def same_bits():
    """Two arrays agree in shape, type and every bit."""
    return _same_bits


@pytest.fixture(scope="session")
def same_tree():
    """Names of the leaves of two states that differ by a bit; `rows` picks rows of the first."""

    def differing(a, b, rows=slice(None)):
        one, two = leaves(a), leaves(b)
        assert one.keys() == two.keys()
        return [name for name in one if not _same_bits(one[name][rows], two[name])]

    return differing


@pytest.fixture(scope="session")
def same_rows():
    """Every seed's trace is its own, and the same played again in each of `parts` as among the first `count` seeds; returns those."""

    def played(run, count, *parts):
        whole = run(range(count))
        known = [whole.trace_hash(row) for row in range(count)]
        assert len(set(known)) == count
        for seeds in parts:
            some = run(seeds)
            assert [some.trace_hash(row) for row, seed in enumerate(seeds) if seed < count] == [known[seed] for seed in seeds if seed < count], seeds
        return whole

    return played


@pytest.fixture(scope="session")
def spoil():
    """Writes into every array in reach that can be written."""

    def write(thing, seen):
        if id(thing) in seen:
            return
        seen.add(id(thing))
        if isinstance(thing, np.ndarray) and thing.dtype != object:
            with contextlib.suppress(ValueError):
                thing[...] = 1
        elif isinstance(thing, (np.ndarray, tuple, list)):
            for part in thing.ravel().tolist() if isinstance(thing, np.ndarray) else thing:
                write(part, seen)
        elif isinstance(thing, dict) or hasattr(thing, "__dict__"):
            write(list((thing if isinstance(thing, dict) else vars(thing)).values()), seen)

    return lambda thing: write(thing, set())


@pytest.fixture(scope="module")
def compiled():
    """Attacks are played by compiled code too, however few steps: it has the bits of plain code, and costs less where it plays again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trace, "MANY", 1)
        yield


@pytest.fixture(scope="session")
def short():
    """A published scenario cut to a short horizon, with an early onset and any other change of its threat model."""

    def make(name="stop-and-go-v0", horizon=60, **threat):
        place = load_scenario(name)
        place = dataclasses.replace(place, horizon=min(horizon, place.horizon))
        return place.with_threat(**({"onset": 10, "end": None} | threat))

    return make


@pytest.fixture(scope="session")
def loop_of():
    """The loop of a scenario under a defence: a name, or an object. Skips the test where a named one has no meaning there."""

    def make(place, defence):
        if not isinstance(defence, str):
            return place.loop(defence)
        try:
            return place.loop(tailgate.make_defence(defence), entries("defence")[defence].uses)
        except NotApplicable as error:
            pytest.skip(str(error))

    return make


@pytest.fixture(scope="session")
def granting():
    """The scenario with what a named attack needs: knowledge, kinds and, where `targets` is left open, wires."""

    def widen(place, attack):
        if entries("attack")[attack].knowledge == "white":
            place = place.with_threat(knowledge="white")
        model, every = place.brief().model, get_args(KindName)
        wider = [{}, {"kinds": every}]
        if not place.threat_model.targets:
            fewest = 0 if model.agents == 1 else len(model.sensors) - 1  # a network may have too many for every choice
            some = [names for n in range(len(model.sensors), fewest, -1) for names in combinations(model.sensors, n)]
            wider += [{"kinds": every, "targets": (*names, *model.actuators)} for names in some]
        for changes in wider:
            try:
                tailgate.make_attack(attack).prepare(place.with_threat(**changes).brief())
            except NotApplicable:
                continue
            return place.with_threat(**changes)
        return place

    return widen


@pytest.fixture(scope="session")
def play(loop_of, granting):
    """The trace of a scenario under a defence and an attack, each a name or an object; grants what a named attack needs."""

    def run(place, defence, attack, seeds, **options):
        if isinstance(attack, str):
            place, attack = granting(place, attack), tailgate.make_attack(attack)
        return rollout(loop_of(place, defence), attack, keys("train", list(seeds)), **options)

    return run


@pytest.fixture
def said(monkeypatch):
    """Return the list of texts that the next pictures write."""
    from tailgate.envs.render.canvas import Canvas

    words, text = [], Canvas.text
    monkeypatch.setattr(Canvas, "text", lambda self, x, y, line, *a, **k: (words.append(line), text(self, x, y, line, *a, **k))[1])
    return words


@pytest.fixture(scope="session")
def linear_model():
    """A one-agent Model from its matrices."""

    def make(A, C, Q, R, B=None, dt=1.0):
        A, C, Q, R = (np.atleast_2d(np.asarray(m, float)) for m in (A, C, Q, R))
        n, q = len(A), len(C)
        B = np.zeros((n, 1)) if B is None else np.asarray(B, float)
        return Model(A, B, np.zeros(n), C[None], Q, R[None], np.eye(1, dtype=bool), dt, tuple(f"y{i}" for i in range(q)))

    return make


def _missing(what):
    if os.environ.get("TAILGATE_REQUIRE_BROWSER") == "1":
        pytest.fail(f"TAILGATE_REQUIRE_BROWSER=1, but there is no {what}")
    pytest.skip(f"no {what}: the page is not tried in a browser")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium; without one its tests are skipped, or fail where TAILGATE_REQUIRE_BROWSER is 1."""
    try:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service
    except ImportError:
        _missing("selenium")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        _missing("Chromium with chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (
        "headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking",
        "disable-component-update", "disable-sync", f"user-data-dir={tmp_path_factory.mktemp('profile')}",
    ):  # fmt: skip
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    window = webdriver.Chrome(options=options, service=Service(executable_path=driver))
    window.get("about:blank")  # its own first page would go on loading
    yield window
    window.quit()


@pytest.fixture
def show(browser):
    """A function that shows what is loaded at a width [px], in light or dark colours."""

    def resize(width, scheme="light"):
        size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        media = {"prefers-color-scheme": scheme, "prefers-reduced-motion": "reduce"}  # a click during a smooth scroll misses
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [{"name": k, "value": v} for k, v in media.items()]})

    return resize


@pytest.fixture
def load(browser, show):
    """A function that loads a file at a width [px] with empty logs, and returns the browser."""

    def fresh(path, width=1280):
        show(width)
        for log in ("browser", "performance"):
            browser.get_log(log)
        browser.get(path.as_uri())
        return browser

    return fresh


@pytest.fixture
def asked(browser):
    """A function that gives the addresses that were asked for since it was called last, data: left out."""

    def addresses():
        events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
        urls = {e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"}
        return {url for url in urls if not url.startswith("data:")}

    return addresses


@pytest.fixture
def small_ensemble(monkeypatch):
    """The standard attack ensemble at a size that a test can pay for."""
    shrink_ensemble(monkeypatch)


def shrink_ensemble(monkeypatch):
    """Make the standard attack ensemble small until the patch is undone."""
    from tailgate.agents.policy.zoo import zoo_names
    from tailgate.ensemble import evolution, members, networks, standard
    from tailgate.ensemble import search as searching

    few = zoo_names()[::5]
    monkeypatch.setattr(networks, "zoo_names", lambda: few)

    effort = searching.Effort(64, 3)
    budget = members.Budget(effort, effort, members.Climb(64, (members.Stage(2, 2),)), members.Climb(64, (members.Stage(2, 2),)), 6, ((2, 8), (1, 8)), members.Pace(16, 1, 1, 8))
    monkeypatch.setitem(members.BUDGETS, "quick", budget)
    monkeypatch.setattr(evolution, "JUDGED", 64)
    for name, value in (("SHOWN", 8), ("COPIED", 64)):
        monkeypatch.setattr(networks, name, value)
    monkeypatch.setattr(members, "FINALISTS", 1)
    for name, value in (("FINAL", 16), ("MORE", 8), ("KEPT", 8)):
        monkeypatch.setattr(searching, name, value)
    monkeypatch.setattr(standard, "FINAL", 16)
