"""Networks and platoons cut short, under jammers and injection of any strength: what tests of distributed defences play."""

import dataclasses
from functools import cache

import numpy as np

import tailgate
from tailgate.core import Prior, Received
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout

RNG = np.random.default_rng(23)


@cache
def place_of(name):
    """A scenario cut short, its attacked agents open to a jammer of any strength from step 5 on."""
    place = load_scenario("thesis-ch5-v0" if name == "weak" else name)
    if name == "weak":  # three modes, each seen by three or four of ten agents
        plant = dataclasses.replace(place.plant, system="modal", graph="complete", states=6)
        place = dataclasses.replace(place, plant=plant, sensor=dataclasses.replace(place.sensor, pattern="modes", sensors=2))
    threat = {"kinds": ("dos_jam", "dropout", "fdi"), "jam_range": (-1e6, 1e6), "fdi_bound": 1e6, "onset": 5, "end": None}
    return dataclasses.replace(place, horizon=30).with_threat(**threat)


@cache
def loop_of(place, defence, uses):
    """The loop, prepared once for all tests."""
    made = Spec("defence", defence).make() if isinstance(defence, str) else defence
    return (place_of(place) if isinstance(place, str) else place).loop(made, uses)


def play(place, defence, attack="none", seeds=4, uses=("measurements", "truth"), **options):
    rival = tailgate.make_attack(attack, **options)
    held = keys("train", range(seeds) if isinstance(seeds, int) else seeds)
    return rollout(loop_of(place, defence, uses), rival, held, terminate=False)


def error(trace, agents=slice(None), after=5):
    """(B,) the largest 2-norm of an estimate's error."""
    return np.linalg.norm((trace.estimate - trace.truth)[after:][:, :, agents], axis=-1).max(axis=(0, 2))


def model_of(name):
    return place_of(name).brief().model


def random_state(model, rows=4, spread=1.0):
    """A prior with random means, and readings near them."""
    shape = (rows, model.agents, model.states)
    prior = Prior(spread * RNG.normal(size=shape), np.broadcast_to(np.eye(model.states), (*shape, model.states)))
    y = 3.0 * RNG.normal(size=(rows, *model.C.shape[:2]))
    return prior, Received(y, np.ones(y.shape, bool), np.zeros(y.shape[:2]))


def spd(rng, count, n, low, high):
    """Symmetric matrices with eigenvalues 10**U(low, high), and their inverses."""
    turn, _ = np.linalg.qr(rng.normal(size=(count, n, n)))
    size = 10.0 ** rng.uniform(low, high, (count, 1, n))
    return (turn * size) @ np.swapaxes(turn, 1, 2), (turn / size) @ np.swapaxes(turn, 1, 2)


def moves(filter_, plan, model, r, accept=None):
    """X - xb (B, N, n) of one update with the innovations r (B, N, q)."""
    shape = (len(r), model.agents, model.states)
    belief = filter_.start(plan, Prior(np.zeros(shape), np.zeros((*shape, model.states))))
    every = np.ones(r.shape, bool)
    innovation = filter_.innovation(plan, belief, Received(r, every if accept is None else accept, np.zeros(shape[:2])))
    return filter_.update(plan, belief, innovation, every if accept is None else accept).x
