"""One contract over the registry: whatever is registered, plug-ins included, obeys the same laws."""

import contextlib
from typing import get_args

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.pytree import leaves
from tailgate.core import Command, Kind, Mode
from tailgate.core.draws import Draws, Keys, Role, keys
from tailgate.core.kinds import KindName
from tailgate.core.registry import entries, make
from tailgate.core.scenario import list_scenarios, list_suites, load_scenario, load_suite
from tailgate.core.schema import fields_of
from tailgate.envs.gym.mixture import Mixture
from tailgate.play.trace import rollout

DEFENCES = tailgate.list_defences()
ATTACKS = [name for name in tailgate.list_attacks() if name not in ("policy", "rules")]  # which need a file
SCENARIOS = list_scenarios()
ONE = [name for name in SCENARIOS if load_scenario(name).plant.size[0] == 1]  # of many agents: tests/test_contract_many.py
REDUNDANT = ("kf_bank", "observer_bank", "l1_decoder", "etpg", "etpl", "l0_robust")  # two sensors are too few for them


def _place(name):
    if "probe" in entries("defence")[name].uses:
        return "radar-following-v0"
    return "redundant-one-v0" if name in REDUNDANT else "stop-and-go-v0"


PLACE = {name: _place(name) for name in DEFENCES}
FAMILIES = ("defence", "filter", "detector", "mitigation", "attack", "plant", "sensor", "controller", "manoeuvre")
ORDER = [5, 63, 0, 1017, 17, 9, 31]  # other companions in another order
EITHER = (31, 17)  # a seed for each attack of a mixture of two


def _batches(run, seeds=(17,)):
    """Every seed's trace is the same when it is played again among 7 or alone as among 64; returns the 64."""
    whole = run(range(64))
    known = [whole.trace_hash(i) for i in range(64)]
    assert len(set(known)) == 64
    some = run(ORDER)
    for i, seed in enumerate(ORDER):
        if seed < 64:
            assert some.trace_hash(i) == known[seed], f"seed {seed} among 7"
    for seed in seeds:
        alone = run([seed])
        assert alone.trace_hash(0) == known[seed], f"seed {seed} alone"
        assert alone.decision_hash(0) == whole.decision_hash(seed)
    return whole


def _play(play, *arguments, **options):
    try:
        return play(*arguments, **options)
    except NotApplicable as error:
        pytest.skip(str(error))


def test_every_defence_applies_somewhere():
    """On car following, or on the radar car where it mutes a probe: the skips below hide no defence."""
    for name in DEFENCES:
        load_scenario(PLACE[name]).loop(tailgate.make_defence(name), entries("defence")[name].uses)


@pytest.mark.thin(40)
@pytest.mark.parametrize("defence", DEFENCES)
def test_rows_of_a_defence_do_not_depend_on_their_batch(defence, short, play):
    """trace_hash of each seed is the same in batches of 1, 7 and 64, in which some readings are falsified and others jammed."""
    place = short(PLACE[defence], kinds=get_args(KindName))
    mix = Mixture((tailgate.make_attack("fdi"), tailgate.make_attack("dos_jam")))
    whole = _batches(lambda seeds: _play(play, place, defence, mix, seeds), EITHER)
    assert [set(np.unique(whole.kind[9:, seed])) - {Kind.NONE} for seed in EITHER] == [{Kind.FDI}, {Kind.DOS_JAM}]


@pytest.mark.thin(7)
@pytest.mark.parametrize("attack", ATTACKS)
def test_rows_of_an_attack_do_not_depend_on_their_batch(attack, short, play):
    """trace_hash of each seed is the same in batches of 1, 7 and 64, under a budget and a cooldown too."""
    _batches(lambda seeds: _play(play, short(budget=20, duration=7, cooldown=2), "chi2_kf", attack, seeds, terminate=False))


@pytest.mark.thin(29)
@pytest.mark.parametrize("name", SCENARIOS)
def test_rows_of_a_scenario_do_not_depend_on_their_batch(name, short, play, same_rows):
    """trace_hash of each seed is the same in batches of 1, 7 and 64, collisions included; of many agents in 1, 2 and 6, for fewer steps."""
    if name in ONE and not name.startswith("highway"):  # a scene is slow
        _batches(lambda seeds: play(short(name, horizon=150), "kf", "fdi_gaussian", seeds))
        return
    whole = same_rows(lambda seeds: play(short(name, horizon=14), "kf", "fdi_gaussian", seeds), 6, [5, 2], [4])
    assert whole.kind[9:].any()


@pytest.mark.thin(30)
@pytest.mark.parametrize("defence", DEFENCES)
def test_outputs_are_finite_and_of_the_right_shape(defence, short, loop_of):
    """Without an attack and under every kind, with the widest jammer, a defence returns finite arrays of the declared shapes and types."""
    place = short(PLACE[defence], jam_range=(-1e6, 1e6), kinds=get_args(KindName))
    loop = loop_of(place, defence)
    names, wide = ("none", "dropout", "dos_jam", "fdi_gaussian"), {"dos_jam": {"low": -1e6, "high": 1e6}}
    mix = Mixture(tuple(tailgate.make_attack(name, **wide.get(name, {})) for name in names))
    trace = rollout(loop, mix, keys("train", range(36)), terminate=False)
    kinds = [frozenset(np.unique(row)) - {Kind.NONE} for row in trace.kind.T]
    assert set(kinds) == {frozenset(), frozenset({Kind.DROPOUT}), frozenset({Kind.DOS_JAM}), frozenset({Kind.FDI})}
    assert trace.estimate.shape == (60, 36, 1, loop.model.states) and trace.score.shape == trace.alarm.shape == trace.mode.shape == (60, 36, 1)
    assert trace.alarm.dtype == bool and set(np.unique(trace.mode)) <= {int(m) for m in Mode}
    assert all(np.isfinite(trace.signals[name]).all() for name in ("estimate", "score", "control", "gap", "wires", "value"))


@pytest.mark.thin(4)
@pytest.mark.parametrize("attack", ATTACKS)
def test_commands_are_well_formed(attack, short, loop_of, granting):
    """A command has the declared shapes and types, and the attack's memory has B first in every leaf."""
    place = granting(short(onset=2), attack)
    loop, rival = loop_of(place, "chi2_kf"), tailgate.make_attack(attack)
    state, plan = loop.start(keys("train", range(5))), _play(rival.prepare, loop.brief)
    memory = rival.start(plan, 5, state.keys.at(Role.ATTACK, np.zeros(5, np.int64)))
    for _ in range(12):
        memory, command = rival.decide(plan, memory, loop.sense(state), state.keys.at(Role.ATTACK, state.k))
        assert isinstance(command, Command) and command.kind.shape == (5,) and command.kind.dtype == np.int8
        assert command.target.shape == command.value.shape == (5, 1, 5) and command.target.dtype == bool
        assert np.isin(command.kind, list(Kind)).all() and np.isfinite(command.value).all()
        assert all(len(leaf) == 5 for leaf in leaves(memory).values())
        state, _ = loop.advance(state, command)


@pytest.mark.thin(3)
@pytest.mark.parametrize("attack", ATTACKS)
def test_an_attack_changes_only_what_is_granted_and_when(attack, short, play):
    """One wire, one window, ten steps: every other wire and step arrives as sent, bit for bit."""
    place = short(targets=("velocity",), onset=15, end=40, budget=10)
    trace = _play(play, place, "chi2_kf", attack, range(8), terminate=False)
    changed = trace.wires != trace.clean
    assert not changed[..., [0, 2, 3]].any()
    step = np.arange(1, 61)[:, None]
    assert not (trace.kind != 0)[np.broadcast_to((step < 15) | (step > 40), (60, 8))].any()
    assert not changed[trace.kind == 0].any() and not trace.target[..., [0, 2, 3]].any()
    assert ((trace.kind != 0).sum(axis=0) <= 10).all()
    if attack != "none":
        assert changed[trace.kind != 0].any()


@pytest.mark.thin(5)
@pytest.mark.parametrize("attack", ATTACKS)
def test_before_onset_an_attacked_episode_is_the_clean_one(attack, short, play):
    """Every signal up to the onset, except what was asked for in vain, equals the clean run bit for bit."""
    place = short(onset=25)
    attacked, clean = (_play(play, place, "kf", name, range(6), terminate=False) for name in (attack, "none"))
    for name in clean.signals:
        if name != "refused":
            np.testing.assert_array_equal(attacked.signals[name][:24], clean.signals[name][:24], err_msg=name)
    if attack not in ("none", "zoo"):  # the policy waits for longer than this episode
        assert not np.array_equal(attacked.estimate[24:], clean.estimate[24:])


@pytest.mark.thin(15)
@pytest.mark.parametrize("defence", DEFENCES)
def test_swapping_the_defence_leaves_the_world_draws(defence, short, play, monkeypatch):
    """Clean runs of two defences draw the same numbers for the world: comparisons are paired."""
    log, fill = [], Draws._numbers

    def spy(self, fill_, shape, tag):
        out = fill(self, fill_, shape, tag)
        if self.stream < 16:
            log.append((self.stream, tag, self.step.tobytes(), out.tobytes()))
        return out

    monkeypatch.setattr(Draws, "_numbers", spy)
    traces, logs = [], []
    for name in (defence, "none"):
        log.clear()
        traces.append(play(short(PLACE[defence]), name, "none", range(5), terminate=False, plain=True))
        logs.append(list(log))
    assert logs[0] == logs[1] and len(logs[0]) > 120
    np.testing.assert_array_equal(traces[0].lead_speed, traces[1].lead_speed)
    q = len(traces[0].model.sensors)
    noise = [t.clean[..., :q] - np.einsum("nqs,kbns->kbnq", t.model.C, t.truth) for t in traces]
    heard = traces[0].valid & traces[1].valid  # a challenge measures nothing; a radar's error grows with the distance
    np.testing.assert_allclose(noise[0][heard], noise[1][heard], atol=1e-2 if traces[0].model.air else 1e-9)


@pytest.mark.thin(4)
@pytest.mark.parametrize("batch", [1, 2, 3, 4, 10])
@pytest.mark.parametrize("defence", DEFENCES)
def test_restart(defence, batch, short, loop_of, same_tree):
    """Restarted rows equal fresh rows of the next episode, the others keep every bit, also when B equals another axis."""
    loop = loop_of(short(PLACE[defence], onset=1), defence)
    rival, rng = tailgate.make_attack("fdi_gaussian"), np.random.default_rng(batch)
    state = loop.start(keys("train", range(batch)))
    plan = rival.prepare(loop.brief)
    for round_ in range(3):
        memory = rival.start(plan, batch, state.keys.at(Role.ATTACK, np.zeros(batch, np.int64)))
        for _ in range(5):
            state, memory, _ = loop.step(state, rival, plan, memory)
        assert all(len(leaf) == batch for leaf in leaves(state).values())
        mask = np.ones(batch, bool) if round_ == 2 else rng.uniform(size=batch) < 0.5
        after = loop.restart(state, mask)
        rows, others = np.flatnonzero(mask), np.flatnonzero(~mask)
        if len(rows):
            fresh = loop.start(Keys(state.keys.key[rows], state.keys.episode[rows] + np.uint32(1)))
            assert same_tree(after, fresh, rows) == []
            assert same_tree(fresh, fresh._replace(k=fresh.k + 1)) == ["k"]  # the comparison can fail
        kept = {name: leaf[others] for name, leaf in leaves(state).items()}
        assert all(np.array_equal(leaf[others], kept[name], equal_nan=True) for name, leaf in leaves(after).items())
        state = after


@pytest.mark.thin(5)
@pytest.mark.parametrize("defence", DEFENCES)
def test_a_restarted_row_plays_on_as_a_fresh_one(defence, short, loop_of):
    """The frames of a restarted row are those of the same episode started alone."""
    loop = loop_of(short(PLACE[defence]), defence)
    nothing = tailgate.make_attack("none")
    plan = nothing.prepare(loop.brief)
    state = loop.start(keys("train", range(4)))
    for _ in range(5):
        state, _, _ = loop.step(state, nothing, plan, None)
    state = loop.restart(state, np.array([False, True, False, True]))
    held = keys("train", [3])
    alone = loop.start(held._replace(episode=held.episode + np.uint32(1)))
    for _ in range(20):
        state, _, ours = loop.step(state, nothing, plan, None)
        alone, _, fresh = loop.step(alone, nothing, plan, None)
        np.testing.assert_array_equal(ours.estimate.x[3], fresh.estimate.x[0])
        np.testing.assert_array_equal(ours.scene.gap[3], fresh.scene.gap[0])
        np.testing.assert_array_equal(ours.wires[3], fresh.wires[0])


@pytest.mark.thin(9)
@pytest.mark.parametrize("defence", DEFENCES)
def test_a_white_box_may_look_ahead_at_will(defence, short, loop_of):
    """Playing with the defence's state that a view shows changes nothing of the episode."""
    loop = loop_of(short(PLACE[defence], knowledge="white", horizon=30), defence)

    class Curious(type(tailgate.make_attack("none"))):
        def decide(self, plan, state, view, draws):
            box = view.defence
            received = view.received._replace(y=view.received.y + 100.0, attacked=np.zeros_like(view.received.valid))
            inner = box.state
            for _ in range(2):
                inner, _ = box.defence.step(box.plan, inner, received, box.known_u, draws)
            return super().decide(plan, state, view, draws)

    held = keys("train", range(3))
    plain, curious = (rollout(loop, a, held) for a in (tailgate.make_attack("none"), Curious()))
    assert [plain.trace_hash(i) for i in range(3)] == [curious.trace_hash(i) for i in range(3)]


@pytest.mark.thin(6)
@pytest.mark.parametrize("defence", DEFENCES)
def test_a_defence_gets_only_what_its_card_declares(defence, short):
    """The loop fills V2V, odometry and the truth about the attack only for those who declare them."""
    uses, seen = entries("defence")[defence].uses, []

    class Spy:
        inner = tailgate.make_defence(defence)
        prepare, start = inner.prepare, inner.start

        def step(self, plan, state, received, known_u, draws):
            seen.append(received)
            return self.inner.step(plan, state, received, known_u, draws)

    rollout(short(PLACE[defence], horizon=20).loop(Spy(), uses), tailgate.make_attack("fdi"), keys("train", [0]))
    assert all((r.v2v is not None) == ("v2v" in uses) and (r.attacked is not None) == ("truth" in uses) for r in seen)
    assert all((r.odometry is not None) == ("odometry" in uses) for r in seen)


@pytest.mark.thin(6)
@pytest.mark.parametrize("defence", DEFENCES)
def test_a_white_box_cannot_write_into_the_defence(defence, short, loop_of, spoil):
    """Whatever of plan and state can be written is a copy: an episode with a vandal equals the plain one."""
    loop = loop_of(short(PLACE[defence], knowledge="white", horizon=20), defence)

    class Vandal(type(tailgate.make_attack("none"))):
        def decide(self, plan, state, view, draws):
            spoil([view.defence.plan, view.defence.state])
            return super().decide(plan, state, view, draws)

    held = keys("train", range(3))
    plain, spoiled = (rollout(loop, a, held) for a in (tailgate.make_attack("none"), Vandal()))
    assert [plain.trace_hash(i) for i in range(3)] == [spoiled.trace_hash(i) for i in range(3)]


def _scribble(tree):
    """Write into every array that can be written; read-only ones are as good as untouched."""
    for leaf in leaves(tree).values():
        with contextlib.suppress(ValueError):
            leaf[...] = ~leaf if leaf.dtype == bool else 1


@pytest.mark.parametrize("knowledge", ["black", "grey", "white"])
def test_an_attack_cannot_write_through_its_view(knowledge, short, loop_of):
    """The channel is the only way: an attack that scribbles over all that it is shown changes nothing of the episode."""
    loop = loop_of(short(knowledge=knowledge, sees_measurement=True), "chi2_kf")

    class Vandal(type(tailgate.make_attack("none"))):
        def decide(self, plan, state, view, draws):
            _scribble(view._replace(defence=None))
            return super().decide(plan, state, view, draws)

    plain, vandal = (rollout(loop, a, keys("train", range(3)), terminate=False) for a in (tailgate.make_attack("none"), Vandal()))
    assert [plain.trace_hash(i) for i in range(3)] == [vandal.trace_hash(i) for i in range(3)]


def test_a_defence_cannot_write_into_the_record(short):
    """A defence that scribbles over what it received, after use, changes neither the record nor what the controller hears."""

    class Vandal(type(tailgate.make_defence("kf"))):
        def step(self, plan, state, received, known_u, draws):
            out = super().step(plan, state, received, known_u.copy(), draws)
            _scribble((received, known_u))
            return out

    plain, vandal = (
        rollout(short().loop(d, ("measurements", "v2v")), tailgate.make_attack("fdi"), keys("train", range(3)), terminate=False)
        for d in (tailgate.make_defence("kf"), Vandal())
    )
    assert [plain.trace_hash(i) for i in range(3)] == [vandal.trace_hash(i) for i in range(3)]


@pytest.mark.parametrize("family, name", [(f, n) for f in FAMILIES for n in entries(f)])
def test_unknown_parameters_are_refused(family, name):
    """An unknown field is an InputError that names it and lists those that exist; every field has a sentence."""
    with pytest.raises(InputError) as caught:
        make(family, name, no_such_field=1)
    text, known = str(caught.value), fields_of(entries(family)[name].cls)
    assert f"{family} {name}" in text and "no_such_field" in text and all(field in text for field in known)
    assert all(f.metadata.get("doc") for f in known.values())
    assert entries(family)[name].summary.endswith(".")


@pytest.mark.parametrize("name", SCENARIOS)
def test_published_scenarios_load_and_hash(name):
    """A scenario's hash is stable, and moves with any change of its threat model."""
    place = load_scenario(name)
    assert place.name == name and place.config_hash == load_scenario(name).config_hash
    assert place.config_hash != place.with_threat(budget=3).config_hash
    assert place.about and place.horizon >= 50


@pytest.mark.parametrize("name", list_suites())
def test_published_suites_name_what_exists(name):
    """Every scenario, defence and attack of a suite is registered."""
    suite = load_suite(name)
    assert set(suite.scenarios) <= set(SCENARIOS)
    assert {text.partition(":")[0] for text in suite.defences} <= set(DEFENCES)
    assert {text.partition(":")[0] for text in suite.attacks} <= set(ATTACKS)
