"""Pictures and replays of a radar: belief at the time of the measurement, challenges, what was heard, and the page in a browser."""

import numpy as np
import pytest
import yaml

pytest.importorskip("PIL")

from tailgate.core import Kind
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.render import canvas as render_canvas
from tailgate.envs.render import following as render_following
from tailgate.envs.render import picture as render
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.replay.episode import episode_of
from tailgate.replay.page import write_page
from tailgate.replay.replay import play

TINY = {
    "about": "Short.", "plant": {"name": "radar_following", "gap": 60.0, "rear": True}, "sensor": "fmcw_radar", "controller": "acc_radar", "horizon": 40,
    "manoeuvre": {"name": "braking", "onset": [10.0, 12.0], "decel": 2.0},
    "threat_model": {"kinds": ["noise_jam", "echo_delay", "dos_jam", "fdi"], "onset": 3, "budget": 20, "delay_bound": 20.0, "jam_range": [0.0, 250.0]},
}  # fmt: skip
GUARD = "cra:challenge=fixed,times=[4,9,16,20]"
SIGN = np.s_[int(render_following.GHOST_WHEELS) + 3 :, render_canvas.WIDTH // 2 :]
PAGES = {
    "attacked": (GUARD, "echo_delay:start_step=14,length=9,delay=8"), "quiet": (GUARD, "none"), "unguarded": ("kf", "noise_jam:start_step=10,length=5"),
    "jammed": (GUARD, "radar_jam:start_step=14,length=9"),
}  # fmt: skip


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    path = tmp_path_factory.mktemp("radar") / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY))
    return str(path)


@pytest.fixture(scope="module")
def replays(tiny):
    """A replay of each sort."""
    return {name: play(run_cell(Cell("s", tiny, None, guard, attack, 1))[0]) for name, (guard, attack) in PAGES.items()}


@pytest.fixture
def env(tiny):
    """An environment after some steps, the attack (0: none) of each."""

    def make(actions, defence=GUARD):
        env = AdversaryVectorEnv(1, render_mode="rgb_array", engine="plain", viewer="plain", scenario=tiny, defence=defence, value=8.0, delay=8.0)
        env.reset(seed=3)
        for action in actions:
            env.step(np.array([action]))
        return env

    return make


def test_the_picture_shows_the_challenge(env):
    """The sign below says when the radar is silent, and the waves before the car are gone; the first picture has neither."""
    start, sent, silent = (env([0] * steps) for steps in (0, 3, 4))
    pictures = {name: made.render()[0] for name, made in (("start", start), ("sent", sent), ("silent", silent))}
    assert silent.state.probed.tolist() == [[False]] and sent.state.probed.tolist() == [[True]]
    assert (pictures["start"][SIGN] != pictures["sent"][SIGN]).any() and (pictures["sent"][SIGN] != pictures["silent"][SIGN]).any()
    muted = sent.state._replace(probed=~sent.state.probed)
    other = render.plain(sent.seat.loop, muted, sent.frame, 0)
    road = np.s_[int(render_canvas.HEADER) : int(render_following.STRIP)]
    assert (other[road] != pictures["sent"][road]).any() and (other[SIGN] != pictures["sent"][SIGN]).any()


def test_a_true_belief_lies_under_the_car(env):
    """The ghost is off by the error of the measurement, not by what the gap changed since."""
    made = env([0] * 12, "none")
    loop, state, frame = made.seat.loop, made.state, made.frame
    exact = frame.truth[..., 0]
    x = state.estimate.x.copy()
    x[..., 0] = exact
    drawn = render.plain(loop, state._replace(estimate=state.estimate._replace(x=x)), frame, 0)
    purple = (np.abs(drawn.astype(int) - [0x7A, 0x2A, 0x6B]) < 12).all(axis=2)
    ghost = np.flatnonzero(purple[270:285].any(axis=0))
    assert abs(ghost[0] - render_following.TAIL) <= 3 and abs(ghost[-1] - render_following.NOSE) <= 3
    assert abs(float(state.plant.lead_x[0] - state.plant.own[0, 0, 0]) - float(exact[0, 0])) > 1.0  # the gap has changed


def test_the_badge_gives_metres_and_watts(env):
    """Over the air one value stands for the whole receiver."""
    made = env([0, 0, 0])
    loop, last = made.seat.loop, made.state.channel.last
    for kind, value, words in ((Kind.ECHO_DELAY, 8.0, "8 m"), (Kind.NOISE_JAM, 0.05, "0.05 W")):
        target = np.broadcast_to([True, True, False], last.target.shape)
        command = last._replace(kind=np.full(1, kind, np.int8), target=target, value=np.where(target, value, 0.0))
        assert render_canvas.aimed(loop, command, 0) == words
    assert set(render_canvas.COMMANDS) == set(Kind)


def test_the_data_of_an_attacked_episode(replays):
    """Challenges at their steps, loud ones above the threshold where the alarm is, one lane for the receiver, beliefs beside their truth."""
    replay, data = replays["attacked"], episode_of(replays["attacked"])
    radar, trace = data["radar"], replay.trace
    muted = [s for s, on in enumerate(radar["muted"], start=1) if on]
    assert muted[:4] == [4, 9, 16, 17] and muted == (np.flatnonzero(~trace.probe[:-1, 0, 0]) + 2).tolist()
    loud = [s for s in muted if radar["energy"][s - 1] > radar["threshold"]]
    assert loud and set(loud) <= set(range(14, 23)) and all(data["alarm"][s - 1] for s in loud)
    assert data["threshold"]["name"] == "energy" and data["threshold"]["rules"]
    (lane,) = data["wires"]
    assert lane["name"] == "receiver" and lane["kinds"] == [Kind.ECHO_DELAY] and {v for v, hit in zip(lane["value"], lane["hit"], strict=True) if hit} == {8.0}
    assert data["kinds"][Kind.ECHO_DELAY]["unit"] == "m" and data["kinds"][Kind.NOISE_JAM]["unit"] == "W"
    error = np.array(data["believed"]["gap"]) - np.array(radar["then"])
    np.testing.assert_allclose(error, trace.estimate[:, 0, 0, 0] - trace.truth[:, 0, 0, 0], atol=2e-3)
    assert [one["name"] for one in data["errors"]] == ["gap-error", "relative-speed-error"]


def test_the_data_without_a_challenge_or_an_attack(replays):
    """A filter makes no challenge and has no threshold of energy; a jammer's values keep a lane for each reading."""
    data = episode_of(replays["unguarded"])
    assert not any(data["radar"]["muted"]) and data["radar"]["threshold"] is None
    assert episode_of(replays["quiet"])["wires"] == []
    assert [lane["name"] for lane in episode_of(replays["jammed"])["wires"]] == ["distance", "relative speed"]
    road = load_road()
    assert episode_of(road)["radar"] is None


def load_road():
    return play(run_cell(Cell("s", "stop-and-go-v0", None, "none", "none", 1))[0])


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["radar-following-v0", "radar-braking-v0", "radar-fast-attacker-v0"])
def test_published_scenarios_play_again(scenario):
    """Bit for bit from the row."""
    for row in run_cell(Cell("s", scenario, 6, "cra", "echo_delay:trigger=near,threshold=60", 2)):
        assert play(row).verdict == "same"


@pytest.mark.parametrize("width", [1280, 375])
@pytest.mark.parametrize("name", PAGES)
def test_the_page_in_a_browser(name, width, replays, tmp_path, browser):
    """No word of the console, nothing wider than the window, a dot for each challenge, filled where it was loud; values under the picture."""
    page = write_page(replays[name], tmp_path / f"{name}.html")
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500})
    browser.get_log("browser")
    browser.get(page.as_uri())
    move = "const s = document.getElementById('slider'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))"
    browser.execute_script(move, 16)
    assert browser.get_log("browser") == []
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    data = episode_of(replays[name])
    dots = browser.execute_script("return [...document.querySelectorAll('#plot-radar circle')].map(c => c.getAttribute('fill'))")
    wanted = [(data["radar"]["energy"][i] > data["radar"]["threshold"]) if on else None for i, on in enumerate(data["radar"]["muted"])]
    assert [fill != "#fff" for fill in dots] == [loud for loud in wanted if loud is not None]
    if name == "attacked":
        badge = browser.find_element("id", "attack").text
        assert "ATTACK: late echo" in badge and "receiver 8 m" in badge


ROAD = {
    "about": "Short.", "plant": {"name": "highway", "ahead": 1, "behind": 1}, "sensor": "fmcw_radar", "controller": "acc_radar", "horizon": 30,
    "manoeuvre": {"name": "constant", "value": 0.0}, "threat_model": {"kinds": ["echo_delay"], "onset": 3, "delay_bound": 20.0},
}  # fmt: skip


@pytest.mark.long
@pytest.mark.page
@pytest.mark.parametrize("name", ["radar", "highway"])
def test_the_picture_says_what_the_plots_say(name, replays, tmp_path, browser):
    """One belief at a step, whoever says it, the start too; the cars have the names of the other pictures."""
    if name == "radar":
        replay = replays["attacked"]
    else:
        pytest.importorskip("highway_env")
        path = tmp_path / "road.yaml"
        path.write_text(yaml.safe_dump(ROAD))
        replay = play(run_cell(Cell("s", str(path), None, "kf", "echo_delay:start_step=10,delay=15", 1))[0])
    data = episode_of(replay)
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False})
    browser.get(write_page(replay, tmp_path / "page.html").as_uri() + "#0")
    browser.execute_script("""
        window.said = [];
        const fill = CanvasRenderingContext2D.prototype.fillText;
        CanvasRenderingContext2D.prototype.fillText = function (words, ...rest) { window.said.push(words); fill.call(this, words, ...rest); };""")
    move = "window.said = []; const s = document.getElementById('slider'); s.value = arguments[0]; s.dispatchEvent(new Event('input')); return window.said"
    key = "return [...document.querySelectorAll('#plot-gap li')].find(li => li.textContent.startsWith('believed')).querySelector('output').textContent"
    for step in (14, 0):
        said, shown, beliefs = browser.execute_script(move, step), browser.execute_script(key), data["believed"]["gap"]
        assert {"ego", "ahead", "behind"} <= {words.removesuffix(" (out of view)") for words in said}
        if step:
            assert any(words.startswith(f"believed gap {beliefs[step - 1]:.1f} m") for words in said)
        if name == "highway":  # short steps: the plots and the picture give the belief of the step
            assert "nothing is measured before step 1" in said if not step else float(shown) == pytest.approx(beliefs[step - 1], abs=0.051)
            assert step or shown == "\N{EN DASH}"
        else:  # long ones: the plots give what is believed of this time
            assert float(shown) == pytest.approx(beliefs[step], abs=0.051)
            assert step or f"this gap is measured in step 1, and then believed to be {beliefs[0]:.1f} m" in said
