"""The road scene: what its state remembers, what its sensors see, its collisions and events, and that seeds reproduce."""

import dataclasses
import subprocess
import sys
import warnings
from functools import partial

import numpy as np
import pytest
import yaml

import tailgate
from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base.errors import InputError
from tailgate.core import Kind, draws, no_command
from tailgate.core.draws import Role
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.envs import FmcwRadar, Highway, RadarCruise
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.evaluation.cells import Cell, evaluate
from tailgate.play.trace import rollout
from tailgate.studies.policies import misfit

pytest.importorskip("highway_env")
from tailgate.envs.plants import highway_scene as hs

FULL = {"braking": (0.2, 1.0), "cut_in": (0.2, 1.0), "cut_gap": (5.0, 40.0)}  # something happens at once


def plant_of(**fields):
    plant = Highway(**fields)
    return plant, plant.prepare(plant.model(FmcwRadar(), RadarCruise()))


def at(step, seeds=(0,)):
    return draws.keys("train", seeds).at(Role.PROCESS, np.full(len(seeds), step))


def begun(seeds=(0,), **fields):
    plant, plan = plant_of(**fields)
    return plant, plan, plant.start(plan, at(0, seeds))


def moved(plant, plan, state, steps, command=0.0, first=0, seeds=(0,)):
    """The states after each of some steps under one command [m/s^2]."""
    out = []
    for k in range(first, first + steps):
        state = plant.step(plan, state, np.full((len(seeds), 1, 1), command), np.zeros(len(seeds)), at(k + 1, seeds))
        out.append(state)
    return out


def runs(name, attack, seeds, horizon=80, defence="none", **plant):
    place = load_scenario(name)
    place = dataclasses.replace(place, horizon=horizon, plant=dataclasses.replace(place.plant, **plant)).with_threat(onset=2, end=None)
    return rollout(place.loop(tailgate.make_defence(defence)), attack, draws.keys("report", list(seeds)))


@dataclasses.dataclass(frozen=True)
class Adds(NoAttack):
    """Adds metres to the distance that the radar reads, from the first step that is allowed."""

    metres: float

    def decide(self, plan, state, view, draws):
        value = np.zeros((len(view.k), 1, 3))
        value[..., 0] = self.metres
        return None, plan.command(view.allowed, Kind.FDI, plan.granted, value)


def test_nothing_heavy_is_imported_and_a_missing_library_is_named():
    """`import tailgate`, a scenario and its public model do without HighwayEnv and pygame; playing without them names the extra, rows too."""
    code = (
        "import sys; sys.modules['highway_env'] = None\n"
        "import tailgate\nfrom tailgate.core.scenario import load_scenario\n"
        "place = load_scenario('highway-v0'); place.brief()\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('pygame', 'highway_env') and sys.modules[m]])\n"
        "try: place.plant.prepare(place.brief().model)\n"
        "except ImportError as error: print(error)\n"
        "from tailgate.evaluation.cells import evaluate\n"
        "print(*evaluate('highway-v0', scenarios=['highway-v0'], defences=['kf'], attacks=['none'], seeds=1)[0]['reason'].split('\\n'))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    quiet, *said = done.stdout.splitlines()
    assert quiet == "[]" and len(said) == 2 and all(line.endswith("pip install 'tailgate[highway]'") for line in said), done.stderr


def test_the_numbers_are_all_that_the_cars_remember():
    """A scene taken out and put back in every step drives as one whose objects live on, to the last bit, pile-ups included."""
    _, plan, state = begun([3])
    one, other = plan.bench, plant_of()[1].bench
    numbers = state.cars[0].copy()
    numbers[:, hs.X] = 1000.0 + 0.25 * (numbers[:, hs.X] - 1000.0)  # a crowd: some crash
    one.put(numbers)
    for k in range(120):
        other.put(numbers)
        if k in (10, 40):
            assert one.cut_in(-20.0, 60.0) == other.cut_in(-20.0, 60.0)
            assert one.brake(2.0, 150.0) == other.brake(2.0, 150.0)
        one.step(0.3), other.step(0.3)
        numbers = np.array(list(other.take()))
        assert np.array_equal(np.array(list(one.take())), numbers), k
        assert one.look() == other.look()
    assert numbers[:, hs.CRASHED].any() and not numbers[:, hs.CRASHED].all() and len(set(numbers[:, hs.LANE])) == 3


def test_the_quicker_answers_are_the_librarys():
    """Neighbours and nearest lanes are those that HighwayEnv's own code finds."""
    _, plan, state = begun([7], **FULL)
    bench, road, base = plan.bench, plan.bench.road, hs.Road.neighbour_vehicles
    bench.put(state.cars[0])
    for k in range(60):
        bench.cut_in(-20.0, 60.0)
        bench.step(0.0)
        for car in bench.cars:
            assert all(road.neighbour_vehicles(car, index) == base(road, car, index) for index in (None, *bench.indices)), k
            assert car.lane_index == hs.RoadNetwork.get_closest_lane_index(road.network, car.position, car.heading)
    assert len({car.lane_index for car in bench.cars}) == 3


def test_a_step_is_a_function_of_its_state(same_tree):
    """The same state, stepped twice with other scenes in between and among other rows, gives the same bits and is not written to."""
    plant, plan, state = begun([0, 1, 2, 3], **FULL)
    for step in range(3):
        state = moved(plant, plan, state, 20, -0.2, 20 * step, (0, 1, 2, 3))[-1]
        held = type(state)(*(x if isinstance(x, tuple) else x.copy() for x in state))
        one, two = (moved(plant, plan, state, 1, -0.2, 99, (0, 1, 2, 3))[-1] for _ in range(2))
        assert same_tree(one, two) == [] and same_tree(held, state) == []
        row = type(state)(state.cars[2:3], state.accel[2:3], state.clock[2:3], type(state.seen)(*(x[2:3] for x in state.seen)), state.over[2:3])
        assert same_tree(one, moved(plant, plan, row, 1, -0.2, 99, (2,))[-1], slice(2, 3)) == []


def test_seeds_reproduce_in_every_batch(same_rows):
    """A seed's trace is one, played again, alone or among others in another order, with events and an attack; seeds differ."""
    attack = tailgate.make_attack("fdi_gaussian", sd=4.0)
    assert same_rows(partial(runs, "highway-cut-in-v0", attack, **FULL), 4, [2, 0], [3]).kind.any()


def test_restarted_rows_are_fresh_and_the_others_untouched(same_tree):
    """loop.restart: the rows of the mask equal a fresh start under their next episode, the others keep every bit."""
    loop = load_scenario("highway-cut-in-v0").loop(tailgate.make_defence("none"))
    state = loop.start(draws.keys("train", range(3)))
    for _ in range(5):
        state, _ = loop.advance(state, no_command(3, 1, 3))
    again = loop.restart(state, np.array([False, True, False]))
    keys = draws.Keys(state.keys.key[1:2], state.keys.episode[1:2] + np.uint32(1))
    assert same_tree(again.plant, loop.start(keys).plant, slice(1, 2)) == []
    assert not same_tree(type(again.plant.seen)(*(x[[0, 2]] for x in again.plant.seen)), type(again.plant.seen)(*(x[[0, 2]] for x in state.plant.seen)))
    assert np.array_equal(again.plant.cars[[0, 2]], state.plant.cars[[0, 2]]) and not np.array_equal(again.plant.cars[1], state.plant.cars[1])


@pytest.mark.long
def test_a_collision_ahead_is_the_scenes():
    """A car told that the gap is 50 m more runs into somebody: the gap is then not above 0, and never before; afterwards all stands still."""
    trace = runs("highway-braking-v0", Adds(50.0), range(2), 300)
    assert trace.collided.any(axis=0).all() and not trace.rear_collided.any()
    for row, n in enumerate(trace.length):
        assert (trace.gap[: n - 1, row] > 0.0).all() and trace.gap[n - 1, row, 0] <= 0.0
        assert trace.speed[n - 1, row, 0] > trace.lead_speed[n - 1, row, 0]  # into it
    plant, plan, state = begun([5], ahead=1)
    crash = [s for s in moved(plant, plan, state, 300, 2.0) if s.over[0]]
    assert len(crash) > 1 and all(np.array_equal(s.cars, crash[0].cars) and np.array_equal(s.seen, crash[0].seen) for s in crash)


def test_a_collision_from_behind():
    """Somebody who cannot brake in time hits the car: rear_gap, and not the gap, is at most 0."""
    plant, plan, state = begun([1])
    cars = state.cars.copy()
    mine = np.flatnonzero(cars[0, 1:, hs.LANE] == plant.lane) + 1
    behind = mine[cars[0, mine, hs.X] < 1000.0][0]
    cars[0, behind, [hs.X, hs.Y, hs.HEADING]] = plan.bench.place(plant.lane, 985.0)
    cars[0, behind, hs.SPEED] = 38.0
    after = moved(plant, plan, state._replace(cars=cars), 20)
    end = next(s for s in after if s.over[0])
    assert end.seen.rear_gap[0] <= 0.0 < end.seen.gap[0] and end.seen.rear_v[0] > end.cars[0, 0, hs.SPEED]
    assert all(s.seen.rear_gap[0] > 0.0 for s in after if not s.over[0])
    scene = plant.scene(plan, end)
    assert scene.rear_gap[0, 0] <= 0.0 < scene.gap[0, 0]


def test_nobody_ahead_is_a_car_at_the_end_of_sight():
    """Without a car in reach the gap is `reach` and the lead keeps the own speed; without one behind the rear gap is infinite."""
    plant, plan, state = begun([2], behind=0, reach=140.0)
    cars = state.cars.copy()
    cars[0, 1:, hs.X] += 400.0
    after = moved(plant, plan, state._replace(cars=cars), 3, 1.0)[-1]
    scene = plant.scene(plan, after)
    assert scene.gap[0, 0] == 140.0 and scene.lead_speed[0, 0] == scene.speed[0, 0] > 25.0 and np.isinf(scene.rear_gap[0, 0])
    d, dv, a, v = plant.truth(plan, after, None)[0, 0]
    assert (d, dv, v) == (140.0, 0.0, scene.speed[0, 0]) and a > 0.0


@pytest.mark.long
def test_cut_ins_and_hard_brakings_happen():
    """A scripted cut-in makes the gap jump to where a car was beside; a scripted braking slows the car ahead down as told."""
    none = tailgate.make_attack("none")
    quiet = {"lane_changes": False, "traffic_speed": (24.0, 25.0), "spacing": (50.0, 55.0)}  # nobody changes lanes but those who cut in
    cut = runs("highway-cut-in-v0", none, range(5), 80, cut_in=(1.0, 4.0), **quiet)
    jump = cut.gap[1:, :, 0] - cut.gap[:-1, :, 0]
    assert ((jump < -8.0) & (cut.gap[1:, :, 0] < 32.0)).any(axis=0).sum() >= 2
    braked = runs("highway-braking-v0", none, range(3), 80, braking=(1.0, 4.0), **quiet)
    assert (braked.gap[1:, :, 0] - braked.gap[:-1, :, 0] > -3.0).all()
    slowing = (braked.lead_speed[1:, :, 0] - braked.lead_speed[:-1, :, 0]) / 0.1
    assert (np.abs(slowing + 6.0) < 1e-6).any(axis=0).sum() >= 2 and not (cut.collided.any() or braked.collided.any())


def test_the_public_model_is_honest_while_the_car_ahead_stays():
    """A x + B v_F predicts the next state to within some centimetres and the car ahead's change of acceleration, on the winding road too."""
    plant, plan, state = begun([4], lane_changes=False)
    model = plant.model(FmcwRadar(), RadarCruise())
    state = moved(plant, plan, state, 1, 0.5)[-1]
    for k in range(60):
        after = moved(plant, plan, state, 1, 1.0 - 0.05 * k, k)[-1]
        x, after_x = plant.truth(plan, state, None)[0, 0], plant.truth(plan, after, None)[0, 0]
        off = model.A @ x + model.B @ plant.known(plan, None, None, after)[0, 0] - after_x
        assert abs(off[0]) < 0.1 and abs(off[1]) <= abs(x[2] - after_x[2]) * model.dt + 1e-9 and off[3] == 0.0
        state = after
    here, heading = state.cars[0, 0, [hs.X, hs.Y]], state.cars[0, 0, hs.HEADING]
    assert abs(plan.bench.lanes[plant.lane].local_coordinates(here)[1]) < 0.5 and heading != 0.0  # it steers along its lane


def test_what_does_not_fit_is_refused():
    """Lanes and spans that make no scene, and a manoeuvre that would drive what drives itself, are named."""
    for fields, named in (({"lane": 3}, "lane"), ({"spacing": (5.0, 50.0)}, "spacing"), ({"cut_in": (9.0, 3.0)}, "cut_in")):
        with pytest.raises(InputError, match=f"plant highway.{named}"):
            Highway(**fields)
    plant, plan, state = begun()
    with pytest.raises(InputError, match="manoeuvre"):
        plant.step(plan, state, np.zeros((1, 1, 1)), np.ones(1), at(1))
    with pytest.raises(RuntimeError, match="drew uniform"):
        plan.bench.road.np_random.uniform()


@pytest.mark.long
def test_the_suite_grants_what_its_attacks_need():
    """An attack of the suite spends its whole budget where the car ahead brakes; what is granted is what its scripts send, and no more."""
    suite = load_suite("highway-v0")
    rows = evaluate("highway-v0", scenarios=["highway-braking-v0"], defences=["none"], attacks=[suite.attacks[1]], seeds=2)
    assert {(row["status"], row["attack_steps"], row["refused_commands"], row["dose"]) for row in rows} == {("ok", 30.0, 0.0, 30)}
    assert {row["threat_model"]["delay_bound"] for row in rows} == {60.0} and "none" in suite.defences


def test_who_was_trained_behind_a_radar_fits_and_who_read_positions_does_not():
    """Observation and actions are those of RadarFollowing under the same threat model; a policy of CarFollowing is refused with a word."""
    held = {"kinds": ["noise_jam", "echo_delay"], "delay_bound": 60.0}
    cell = Cell("s", "highway-cut-in-v0", 30, "none", "zoo:name=radar-following-cra-0", 1, threat=held)
    assert misfit(cell) == ""
    assert "last_position" in misfit(dataclasses.replace(cell, attack="zoo:name=car-following-chi2_kf-0", threat={"kinds": ["dos_jam", "fdi"]}))
    granted = load_suite("highway-v0").threat
    here, there = (load_scenario(name).with_threat(**granted).brief() for name in ("highway-v0", "radar-following-v0"))
    assert ObservationCodec(here).names == ObservationCodec(there).names
    one, two = ([mode.name for mode in ActionCodec(ActionSpec(value=30.0), brief).modes] for brief in (here, there))
    assert one == two and "echo_delay" in one


def test_both_checkers_pass(tmp_path):
    """gymnasium's and Stable-Baselines3's check_env on a short scene, without a warning."""
    import gymnasium
    from gymnasium.utils.env_checker import check_env

    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump({
        "plant": {"name": "highway", "ahead": 1, "behind": 1}, "sensor": "fmcw_radar", "controller": "acc_radar", "horizon": 30,
        "manoeuvre": {"name": "constant", "value": 0.0}, "threat_model": {"kinds": ["fdi", "echo_delay"], "onset": 3},
    }))  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for knowledge in ("black", "white"):
            arguments = {"scenario": str(path), "knowledge": knowledge}
            check_env(gymnasium.make("tailgate/Highway-v0", **arguments).unwrapped, skip_render_check=True)
            sb3.check_env(gymnasium.make("tailgate/Highway-v0", **arguments), warn=True)
