"""The standard attack ensemble: many scripts in one program, the search, and the command."""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import pytest

from tailgate.agents.learners.cem import scales
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import draws
from tailgate.core.draws import Keys
from tailgate.core.kinds import EFFECTS, Kind
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_suite
from tailgate.engine.agreement import Untraced
from tailgate.ensemble import evolution, members, networks, standard
from tailgate.ensemble import search as searching
from tailgate.ensemble.battery import Played, battery_of, played_plainly
from tailgate.ensemble.climb import Climb, Stage, climbed
from tailgate.ensemble.evolution import Evolution
from tailgate.ensemble.networks import Race, _without_copies, learned, ramp_of, starts_of
from tailgate.ensemble.search import Arena, Effort, at_start, search
from tailgate.ensemble.space import FAMILIES, GENES, NEVER
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout

EVERY = {"kinds": tuple(kind.name.lower() for kind in Kind if kind and not EFFECTS[kind].over_air)}
AIR = {"kinds": ("noise_jam", "echo_delay", "fdi", "dos_jam"), "jam_power": 60.0, "delay_bound": 60.0}
PLACES = {
    "car": ("gusty-stop-and-go-v0", "chi2_kf", 30, EVERY), "radar": ("radar-braking-v0", "chi2_kf", 9, AIR),
    "platoon": ("platoon-gusty-v0", "dkf", 40, EVERY | {"agents": (1, 2)}), "network": ("network-restless-v0", "dkf", 20, EVERY),
}  # fmt: skip
EPISODES = 3
SMALL = Effort(64, 3)


def arena(name, **changes):
    scenario, defence, dose, threat = PLACES[name]
    return dataclasses.replace(Arena("test", scenario, dose, defence, dict(threat), 5.0 if name == "network" else None), **changes)


def played(place, scripts, plainly=False):
    """Play scripts on the same episodes."""
    count, loop = len(scripts[-1]), place.loop
    keys = draws.keys("tune", range(EPISODES))
    many = Keys(np.tile(keys.key, (count, 1)), np.tile(keys[1], count))
    attack, memory = at_start(scripts.take(np.repeat(np.arange(count), EPISODES)), loop.model.agents)
    if plainly:
        return played_plainly(loop, attack, loop.brief, many, memory)
    made = battery_of(loop, attack, loop.brief, at_start(scripts.take(np.arange(64) % count), loop.model.agents)[1])
    assert not isinstance(made, Untraced), made
    return made.play(many, memory)


def as_evaluated(place, text):
    """Return the outcome of an attack as `evaluate` plays it, and if it attacked."""
    spec = Spec("attack", text)
    attack = spec.make()
    trace = rollout(place.seat(spec.entry.knowledge, attack), attack, draws.keys("tune", range(EPISODES)))
    gap = METRICS["min_gap"](trace) if place.loop.model.followers.any() else np.full(EPISODES, np.inf)
    others = (METRICS[name](trace) for name in ("max_error", "distance_travelled"))
    return Played(METRICS["crashed"](trace) > 0, gap, *others), bool((trace.kind != 0).any())


def assert_same(place, found, wanted, text):
    """Collisions, smallest gaps and largest errors are equal to the last bit."""
    assert np.array_equal(found.ended, wanted.ended), text
    if place.loop.model.followers.any():
        first = place.loop.plant.scene(place.loop.plan.plant, place.loop.start(draws.keys("tune", range(EPISODES))).plant)
        before = np.min(first.gap[:, place.loop.model.followers], axis=1)
        assert np.array_equal(np.minimum(found.gap, before), wanted.gap), text
        assert np.array_equal(found.moved, wanted.moved), text
    else:
        assert np.array_equal(found.error, wanted.error), text


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.thin(2) if name in ("platoon", "network") else ()) for name in PLACES]
)
def test_a_row_plays_what_its_text_says(name):
    """For every family of scripts."""
    place, rng = arena(name), np.random.default_rng(7)
    space, count, attacked = place.space, len(place.space.families), 0
    genomes = rng.random((count, len(GENES)))
    genomes[:, 0] = (np.arange(count) % len(space.families) + 0.5) / len(space.families)
    outcome = played(place, space.scripts(genomes))
    for i, text in enumerate(map(space.text, genomes)):
        wanted, on = as_evaluated(place, text)
        assert_same(place, Played(*(part[i * EPISODES : (i + 1) * EPISODES] for part in outcome)), wanted, text)
        attacked += on
    assert attacked > count / 3
    assert {f.name for f in space.families} == {f.name for f in FAMILIES if {f.kind, f.then or f.kind} <= _granted(place)}


@pytest.mark.thin(6)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.thin(2) if name in ("platoon", "network") else ()) for name in PLACES]
)
def test_a_row_plays_what_the_file_of_its_program_says(name, tmp_path):
    """Both phases, whatever ends the first."""
    place, rng = arena(name), np.random.default_rng(8)
    space, count, attacked = place.programs, len(place.programs.families), 0
    genomes = rng.random((count, space.genes))
    genomes[:, 0] = (np.arange(count) % len(space.families) + 0.5) / len(space.families)
    genomes[:, -1] *= 0.5
    outcome = played(place, space.scripts(genomes))
    for i, genome in enumerate(genomes):
        wanted, on = as_evaluated(place, space.text(genome, tmp_path))
        assert_same(place, Played(*(part[i * EPISODES : (i + 1) * EPISODES] for part in outcome)), wanted, space.label(genome))
        attacked += on
    assert attacked > count / 4


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", ["car", "radar", "platoon"])
@pytest.mark.parametrize("form", ["feedbacks", "segments"])
def test_a_row_plays_what_the_text_of_its_point_says(name, form):
    """With every kind, trigger and set of wires."""
    place, rng, attacked = arena(name), np.random.default_rng(9), 0
    space = getattr(place, form)
    points = [space.drawn(rng) for _ in range(24)]
    outcome = played(place, space.numbers(points))
    for i, text in enumerate(map(space.text, points)):
        wanted, on = as_evaluated(place, text)
        assert_same(place, Played(*(part[i * EPISODES : (i + 1) * EPISODES] for part in outcome)), wanted, text)
        attacked += on
    assert attacked > 4 and {point.choice.kind for point in points} == set(space.kinds)


def test_single_steps_with_every_pause_begin_the_search_of_scripts():
    """Every family, with both signs where values have one. A single pause defeats a defence that trusts again after 20 steps."""
    suite = load_suite("quick-v1")
    place = Arena(suite.name, "gusty-stop-and-go-v0", 12, "safe_state_brake", dict(suite.granted), suite.bound, suite.progress)
    texts = [place.space.text(genome) for genome in place.space.rhythms]
    for space in (place.space, arena("radar").space):
        found = [space.text(genome) for genome in space.rhythms]
        assert len(set(found)) == len(found) == 30 * sum(1 + (one.kind in (Kind.FDI, Kind.DOS_JAM)) for one in space.families)
    assert any(text.startswith("fdi_ramp:base=50,rate=8.333,") for text in texts)
    assert {f"fdi:value={value},start_step=50,burst=1,pause={pause}" for value in (-50, 50) for pause in (1, 20, 30)} <= set(texts)
    scores = place.scores(place.space.scripts(place.space.rhythms), 0, 16)
    harmful = {text for text, score in zip(texts, scores, strict=True) if score > 0.2 * 16}
    assert harmful == {f"{name},start_step=50,burst=1,pause=20" for name in ("fdi:value=50", "fdi_then_jam:value=50,inject=1", "fdi_ramp:base=50,rate=8.333,limit=50")}
    assert len(dataclasses.replace(place, dose=1).space.rhythms) == 0


@pytest.mark.parametrize("form", ["feedbacks", "segments"])
def test_a_climb_finds_more_than_the_random_attacks_that_it_begins_with(form):
    """The same attacks each time, the most harmful first; where nobody drives, none."""
    suite, effort = load_suite("radar-v1"), Climb(256, (Stage(4, 12),))
    place = Arena(suite.name, "radar-braking-v0", 4, "cusum_kf", dict(suite.granted), suite.bound, suite.progress)
    told = []
    space = getattr(place, form)
    found = climbed(place, space, effort, 0, lambda *one: told.append(one))
    assert found == climbed(place, space, effort) != climbed(place, space, effort, 1)
    assert [one[:2] for one in told] == [(i, 12) for i in range(1, 13)] and told[-1][3] > told[0][3] + 0.25  # 0.09 by chance alone
    assert climbed(arena("network"), getattr(arena("network"), form), effort) == []


def test_ghosts_play_what_their_text_says_to_the_last_digits():
    """Each ends before a reading leaves the bounds; where cars drive there are none."""
    place, rng = arena("network"), np.random.default_rng(3)
    points = [place.ghosts.drawn(rng) for _ in range(12)]
    outcome, moved = played(place, place.ghosts.numbers(points)), 0
    for i, text in enumerate(map(place.ghosts.text, points)):
        wanted, mine = as_evaluated(place, text)[0], outcome.error[i * EPISODES : (i + 1) * EPISODES]
        assert np.allclose(mine, wanted.error, rtol=1e-9), text
        moved += bool((mine > 2.0 * np.median(outcome.error)).any())
    assert (place.ghosts.numbers(points).last > 0).all()
    assert moved and {point.choice.grows for point in points} == {True, False}
    assert not arena("car").ghosts.kinds


def test_programs_around_scripts_hold_them():
    """A script that changes its kind is split into two phases that do the same."""
    place = arena("car")
    genomes = np.random.default_rng(9).random((200, len(GENES)))
    space, programs = place.space, place.programs
    several = [
        g
        for g in genomes
        if space.family(g).then and space.rows(g[None]).burst[0] == NEVER and space.budget - 1 > space.rows(g[None]).switch[0]
    ]
    assert several
    first = programs.around(space, np.array(several), np.random.default_rng(0))
    one, two = played(place, space.scripts(np.array(several))), played(place, programs.scripts(first))
    near = np.abs(one.gap - two.gap) < 0.05
    assert np.mean(near) > 0.8 and np.unique(np.round(one.gap, 2)).size > 10


def _granted(place):
    return {Kind[name.upper()] for name in place.threat["kinds"]}


def test_the_plain_loop_plays_the_same():
    place = arena("radar")
    scripts = place.space.scripts(np.random.default_rng(1).random((40, len(GENES))))
    forms = (place.feedbacks, place.segments)
    points = [space.numbers([space.drawn(np.random.default_rng(seed)) for seed in range(24)]) for space in forms]
    for attacks in (scripts, *points):
        fast, plain = played(place, attacks), played(place, attacks, plainly=True)
        assert all(np.array_equal(a, b) for a, b in zip(fast, plain, strict=True)) and plain.ended.any()


@pytest.mark.long
def test_numbers_lie_within_the_threat_model():
    """The channel refuses nothing that the space proposes for its value."""
    for name in PLACES:
        space = arena(name).space
        rows = space.rows(np.random.default_rng(3).random((500, len(GENES))))
        for number in set(rows.kind.tolist()):
            effect, here = EFFECTS[number], rows.kind == number
            if effect.valued:
                value = np.broadcast_to(rows.base[here, None, None], rows.target[here].shape)
                assert effect.grants(space.brief.limits, effect.clip(space.brief.limits, value)).all()
        assert (rows.burst >= 1).all() and (rows.start >= 1).all() and not (rows.target & ~space.brief.granted).any()
        assert len({space.text(genome) for genome in np.random.default_rng(4).random((50, len(GENES)))}) > 45


def test_a_collision_that_ends_no_episode_is_damage():
    place = dataclasses.replace(arena("car"), scenario="thesis-ch4-v0", defence="none", dose=None, threat={})
    scripts = place.space.scripts(np.random.default_rng(0).random((40, len(GENES))))
    made = [played(place, scripts, plainly) for plainly in (False, True)]
    damage = [place.harm(one)[0] for one in made]
    assert not made[0].ended.any() and damage[0].any() and not damage[0].all() and (damage[0] == damage[1]).all()
    hurt = int(np.argmax(damage[0].reshape(40, EPISODES).sum(axis=1)))
    text = place.space.text(np.random.default_rng(0).random((40, len(GENES)))[hurt])
    wanted, _ = as_evaluated(place, text)
    assert wanted.ended.tolist() == damage[0].reshape(40, EPISODES)[hurt].tolist()


def test_a_search_finds_what_no_listed_attack_does():
    """A late echo that waits for a slow car: the board's attacks damage 3 % of the episodes, the search over 35 %."""
    suite = load_suite("radar-v0")
    place = Arena(suite.name, "radar-braking-v0", 4, "chi2_kf", dict(suite.threat), suite.bound)
    told = []
    found = search(place, place.space, Effort(512, 4), tell=lambda *words: told.append(words))
    best = place.best(map(place.space.text, found[:6]))
    assert best[0].damage > 0.35 and best[0].attack.startswith("echo_") and best[0].episodes == searching.FINAL
    assert [one.score for one in best] == sorted((one.score for one in best), reverse=True)
    assert [words[:2] for words in told] == [(n, 4) for n in range(1, 5)]
    one, same, other = (search(place, place.space, Effort(128, 2), seed=seed) for seed in (0, 0, 1))
    assert np.array_equal(one, same) and one.shape == other.shape and not np.array_equal(one, other)


@functools.cache
def car_starts():
    return starts_of(arena("car"), "black", [], 0)


@pytest.mark.long
def test_a_policy_is_played_as_its_file_says(tmp_path, monkeypatch):
    """One program plays policies of any weights, to the bit of `evaluate`."""
    place = arena("car")
    monkeypatch.setattr(evolution, "JUDGED", 64)
    run, rng = Evolution(place, "black", car_starts()[0]), np.random.default_rng(0)
    thetas = [run.first + rng.standard_normal(run.first.size) for _ in range(2)]
    played = run.played(thetas, "tune", 0, EPISODES)
    for theta, one in zip(thetas, played, strict=True):
        run.champion = (0.0, theta)
        wanted, _ = as_evaluated(place, run.write(tmp_path, 0))
        assert_same(place, one, wanted, "policy")
    run.battery = Untraced("as if the engine did not trace the defence")
    for plain, one in zip(run.played(thetas, "tune", 0, EPISODES), played, strict=True):
        assert_same(place, plain, one, "policy in the plain loop")


@pytest.mark.long
def test_starts(monkeypatch):
    """Rest and what a script does in every form, at its size and on its wires; published policies against the defence before others."""
    monkeypatch.setattr(networks, "SHOWN", 8)
    place, script = (
        arena("car", threat={"kinds": ("dos_jam", "fdi"), "fdi_bound": 4.0}),
        "fdi:trigger=near,threshold=40,value=-2,targets=[velocity]",
    )
    starts = starts_of(place, "black", [script], 0)
    forms = ["hidden layer of 16, 1 frame", "linear, 4 frames", "linear, 1 frame, a ramp from -1 by 0.2"]
    names = [f"{name} ({form})" for form in forms for name in ("rest", f"as {script}")]
    assert [start.name for start in starts[:6]] == names and "-chi2_kf-" in starts[6].name
    assert {"fdi-*0.5:velocity", "fdi+", "dos_jam:position"} <= {mode.name for mode in starts[1].plan.action.modes}
    assert [start.name for start in starts_of(place, "black", [script], 0, names[3:5])[:2]] == names[3:5]


def test_a_network_of_many_wires_sees_fewer_steps():
    """Weights of a layer of more than LARGE numbers would be constants of the program, and nothing would be learned."""
    codec, deep = SimpleNamespace(size=91), SimpleNamespace(names=("one",) * 384)  # network-restless-v0, wire by wire
    assert networks._small(networks.FORMS, codec, deep) == [networks.Form(1, 16), networks.Form(2, 0)]
    assert networks._small(networks.FORMS, SimpleNamespace(size=7), deep) == list(networks.FORMS)


@pytest.mark.long
def test_a_published_start_keeps_its_kinds(tmp_path):
    """A published policy that learned with fewer kinds than are granted goes on with its own, and its file says so."""
    place = arena("car")
    start = next(one for one in car_starts() if one.name.startswith("zoo"))
    wanted, attacks = as_evaluated(place, Evolution(place, "black", start).write(tmp_path, 0))
    assert attacks
    again, _ = as_evaluated(place, f"zoo:name={start.name.partition(' ')[2]}")
    np.testing.assert_array_equal(wanted.gap, again.gap)


@pytest.mark.long
def test_no_two_starts_share_a_name():
    """Their files are named by it: two ramps, one of a script of one size, have two names."""
    place = arena("car", threat={"kinds": ("dos_jam", "fdi"), "fdi_bound": 4.0})
    scripts = [f"{name},trigger=near,threshold=40" for name in ("fdi:value=-2", "fdi_ramp:base=-2.4,rate=0.5")]
    names = [one.name for one in starts_of(place, "black", scripts, 0)]
    assert len(set(names)) == len(names) and sum("a ramp from" in name for name in names) == 4


def test_a_ramp_is_learned_in_its_steps():
    """A ramp says the first value and the rate; a script of one size begins at half of it; a hold has no value that could grow."""
    place = arena("car", threat={"kinds": ("dos_hold", "fdi"), "fdi_bound": 4.0})
    ramp, flat = (ramp_of(place, f"{name},trigger=near,threshold=40") for name in ("fdi_ramp:base=-2.4,rate=0.5", "fdi:value=-9"))
    assert (ramp.action, ramp.value, ramp.rate) == ("ramp", -2.4, 0.5) and (flat.value, flat.rate) == (-4.0, 0.9)
    assert ramp_of(place, "dos_hold:trigger=near,threshold=40") is None


def test_of_copies_of_a_script_the_best_one_runs():
    """Forms differ in how well they imitate: the worse copy of a script does not take part; all that rest do."""
    runs = [SimpleNamespace(start=SimpleNamespace(script=script), champion=(score, None)) for script, score in
            (("", 0.1), ("a", 0.5), ("", 0.1), ("a", 0.7), ("b", 0.2))]  # fmt: skip
    assert _without_copies(runs) == [runs[0], runs[2], runs[3], runs[4]]


def test_a_still_observation_keeps_its_size():
    """Small observations are scaled up before a network learns from them; one that does not change is left as it is."""
    seen = np.array([[0.0, 1.0, 5.0], [0.02, -1.0, 5.0]], np.float32)
    np.testing.assert_allclose(scales(seen), [0.01, 1.0, 1.0], rtol=1e-6)


@pytest.mark.long
def test_the_clean_distance_is_the_metric(monkeypatch):
    """The distances that an attacked run is judged by are those of the clean run, to the bit, in both engines."""
    place = dataclasses.replace(arena("car"), progress=0.5)
    wanted = METRICS["distance_travelled"](rollout(place.loop, Spec("attack", "none").make(), draws.keys("tune", range(3, 11))))
    np.testing.assert_array_equal(place.reach("tune", 3, 8), wanted)
    monkeypatch.setattr(searching, "battery_of", lambda *_: Untraced("asked for"))
    np.testing.assert_array_equal(dataclasses.replace(place).reach("tune", 3, 8), wanted)


@pytest.mark.long
def test_policies_are_learned(tmp_path, monkeypatch):
    """From rest alone, a network finds an echo that the gate lets through; the same seed finds the same network."""
    suite = load_suite("radar-v0")
    place = Arena(suite.name, "radar-braking-v0", 9, "kf", dict(suite.threat), suite.bound)
    monkeypatch.setattr(networks, "JUDGED", 128)
    race = Race(16, (networks.Phase(8, 16), networks.Phase(4, 32)))
    texts, starts = learned(place, "black", [], race, 0, tmp_path)
    assert all(name.startswith("rest") for name in starts[:1])
    damage = place.confirmed(texts[0], "select", 0, 128)[0]
    assert damage > place.confirmed("none", "select", 0, 128)[0] + 0.3
    held = [(tmp_path / "policies" / name).read_bytes() for name in sorted(path.name for path in (tmp_path / "policies").iterdir())]
    assert learned(place, "black", [], race, 0, tmp_path).attacks == texts
    assert held == [path.read_bytes() for path in sorted((tmp_path / "policies").iterdir())]
    assert race.episodes(3, 1) == 3 * 128 + 3 * (8 * 16 * 16 + 128) + 2 * (4 * 32 * 16 + 128)


@pytest.mark.long
def test_where_nobody_drives_an_error_is_damage(monkeypatch):
    monkeypatch.setattr(searching, "FINAL", 16)
    place = arena("network")
    found = place.best([place.space.text(search(place, place.space, Effort(64, 1))[0])])
    assert 0.0 <= found[0].damage <= 1.0
    with pytest.raises(InputError, match="bound: got None; expected an error that counts as damage"):
        search(dataclasses.replace(place, bound=None), place.space, SMALL)


def test_an_error_of_the_defence_ends_its_search(monkeypatch, tmp_path):
    """It is no reason to leave a member out: a defence that breaks under a search would be attacked less, and ranked."""
    place = arena("car")
    monkeypatch.setattr(networks, "_drawn", lambda *_: (_ for _ in ()).throw(InputError("defence output x", "NaN or infinity", "finite numbers")))
    monkeypatch.setattr(members, "members_of", lambda hunt: [one for one in members.MEMBERS if one.name == "networks"])
    hunt = members.Hunt(place, standard.BUDGETS["quick"], 0, tmp_path)
    with pytest.raises(InputError, match="defence output x"):
        members.harvest(hunt)
    monkeypatch.setattr(Arena, "confirmed", lambda *_: (_ for _ in ()).throw(NotApplicable("defence", "mine", "no search")))
    with pytest.raises(NotApplicable, match="no search"):
        place.promising(["fdi"])
    monkeypatch.undo()
    nothing = arena("car", threat={"kinds": ()})
    with pytest.raises(searching.Meaningless):
        starts_of(nothing, "black", [], 0)


def test_a_defence_without_a_look_has_no_white_box(monkeypatch):
    """The attack finds that out when it plays; the search goes on."""
    place = dataclasses.replace(arena("car"), defence="brake_kf")
    monkeypatch.setattr(type(place.loop.defence), "look", property(), raising=False)
    assert place.promising(["stealth", "fdi:value=3"]) == ["fdi:value=3"]


def test_computed_optima_are_no_members(monkeypatch):
    """They count for no rank, and would take the place of the best white box that does."""
    place, asked = arena("car"), []
    monkeypatch.setattr(Arena, "promising", lambda self, texts: asked.extend(texts) or [])
    members._white_box(members.Hunt(place, standard.BUDGETS["quick"], 0, None))
    assert asked and not any(Spec("attack", text).entry.optimal for text in asked)
