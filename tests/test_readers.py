"""Readers of recordings: each format gives the same following; 100 malformed files are each one clear error."""

import json
import re

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.roads.fcd import fcd
from tailgate.roads.readers import Choice, mapping_of, read
from tailgate.roads.recording import Raw, checked

from . import logs


def _file(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return str(path)


def _read(folder, kind, text=None, choice=None, told=False):
    name, make = logs.TEXTS[kind]
    choice = choice or Choice(mapping=mapping_of(logs.MAP) if kind == "csv" else ())
    return read(_file(folder, name, make() if text is None else text), kind if told else None, choice)


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("kind", [*logs.TEXTS, "comma2k19"])
def test_every_format_gives_the_same_following(kind, told, tmp_path):
    found = read(str(logs.comma(tmp_path)), kind if told else None) if kind == "comma2k19" else _read(tmp_path, kind, told=told)
    assert len(found) == 1 and found[0].dt == pytest.approx(0.1) and found[0].samples == len(logs.T) and not found[0].repairs
    part = found[0].segments[0]
    assert part.seen.all() and np.abs(part.gap - logs.GAP).max() < 2e-3
    assert np.abs(part.speed - logs.OWN).max() < 1e-3 and np.abs(part.relative_speed - logs.LEAD + logs.OWN).max() < 2e-3


def test_a_string_gives_a_recording_for_each_follower():
    assert [r.name for r in read("asta-braking")] == ["car 2", "car 3", "car 4", "car 5"]
    assert [r.name for r in read("asta-braking", choice=Choice(vehicle="4"))] == ["car 4"]
    assert read("comma2k19-radar")[0].repairs == {"samples interpolated to even times": 1055}


def test_an_address_that_another_car_gets_is_another_track(tmp_path):
    can = logs.comma(tmp_path) / "processed_log" / "CAN" / "radar"
    values = np.load(can / "value")
    values[200:, 0] += 40.0
    values[200:203, 6] = 1.0
    logs.save(can / "value", values)
    (found,) = read(str(tmp_path))
    assert found.samples == 400 and found.segments[0].begin == pytest.approx(20.0) and np.abs(found.segments[0].gap - 40.0 - logs.GAP[200:]).max() < 2e-3


def test_a_hole_in_the_own_speed_is_a_hole_in_time(tmp_path):
    """It is the input of every defence: nothing is interpolated across it."""
    can = logs.comma(tmp_path) / "processed_log" / "CAN" / "speed"
    kept = (logs.T < 20.0) | (logs.T > 40.0)
    logs.save(can / "t", logs.T[kept])
    logs.save(can / "value", logs.OWN[kept])
    (found,) = read(str(tmp_path))
    assert found.repairs == {"holes in time": 1} and [round(part.begin, 6) for part in found.segments] == [0.0, 40.1]


def test_a_silent_or_oncoming_sender_is_not_seen(tmp_path):
    lines = [json.loads(line) for line in logs.veremi().splitlines()]
    quiet = [line for line in lines if line["type"] == 2 or not 10.0 < line["rcvTime"] < 30.0]
    (found,) = _read(tmp_path, "veremi", "\n".join(map(json.dumps, quiet)))
    seen = found.segments[0].seen
    assert not seen[102:299].any() and seen[:100].all() and seen[301:].all()
    for line in lines:
        if line["type"] == 3 and line["rcvTime"] < 20.0:
            line["spd"][0] *= -1.0
    (found,) = _read(tmp_path, "veremi", "\n".join(map(json.dumps, lines)))
    assert not found.segments[0].seen[:199].any() and found.segments[0].seen[201:].all()


def test_a_car_between_two_others_is_seen_in_place_of_the_first(tmp_path):
    x = np.stack([logs.X_LEAD + 60.0, np.where(logs.T < 40.0, logs.X_LEAD + 90.0, logs.X_LEAD + 32.0), logs.X_OWN], axis=1)
    v = np.stack([logs.LEAD, logs.LEAD, logs.OWN], axis=1)
    (found,) = read(_file(tmp_path, "a.xml", fcd(0.1, ["first", "second", "me"], x, v, 0.0 * v)), choice=Choice(vehicle="me", lead="first"))
    assert found.segments[0].seen[:399].all() and not found.segments[0].seen[401:].any()


def test_short_trajectories_among_others_are_dropped_and_counted(tmp_path):
    short = [line.replace("7,", "8,", 1) for line in logs.ultra_av().splitlines()[1:16]]
    (found,) = _read(tmp_path, "ultra-av", logs.ultra_av() + "\n".join(short) + "\n")
    assert found.samples == len(logs.T) and found.repairs == {"recordings below 5 s or 20 samples dropped": 1}


ROUGH = {  # distance of samples [s], rounding of the times [s]
    "60 Hz in ms": (1 / 60, 1e-3), "15 Hz in hundredths": (1 / 15, 1e-2), "exact 60 Hz": (1 / 60, 0.0), "exact 30 Hz": (1 / 30, 0.0),
    "30 Hz in ms": (1 / 30, 1e-3),
}  # fmt: skip


@pytest.mark.parametrize("name", ROUGH)
def test_times_that_are_rounded_keep_their_samples(name):
    """A rounded distance of samples does not add up over ten minutes, and even times are not smoothed."""
    dt, grain = ROUGH[name]
    t = dt * np.arange(round(600.0 / dt))
    told = np.round(t / grain) * grain if grain else t
    noise = np.random.default_rng(0).standard_normal(len(t))
    found = checked(Raw("", told, 30.0 + 0.15 * noise, 0.0 * t, 20.0 + 0.0 * t), "here")
    gap = found.segments[0].gap
    assert found.samples == len(t) and abs(found.dt / dt - 1.0) < 5e-4  # four digits, so that one rate is one number
    assert np.corrcoef(gap, noise)[0, 1] > 0.98 and abs(gap.std() / (0.15 * noise.std()) - 1.0) < 0.05
    assert grain or found.repairs == {}


def test_a_sample_too_many_is_no_traceback():
    t = np.sort(np.append(0.1 * np.arange(200), 5.05))
    found = checked(Raw("", t, 30.0 + 0.1 * np.sin(t), 0.0 * t, 20.0 + 0.0 * t), "here")
    assert found.samples == 200 and found.dt == 0.1


def test_repairs_are_counted():
    gap = logs.GAP.copy()
    gap[50:60], gap[70] = np.nan, -1.0
    t = np.concatenate([logs.T[:200], [logs.T[199]], logs.T[200:400], logs.T[400:] + 3.0])
    columns = [np.insert(x, 200, x[199]) for x in (gap, logs.LEAD - logs.OWN, logs.OWN)]
    found = checked(Raw("a", t, *columns), "file")
    assert found.repairs == {"repeated times dropped": 1, "readings that are no number": 10, "gaps not above 0": 1, "holes in time": 1}
    assert [len(part.gap) for part in found.segments] == [400, 200] and found.segments[1].begin == pytest.approx(43.0)
    assert (~found.segments[0].seen).sum() == 11 and found.segments[0].gap[55] == found.segments[0].gap[49]


def test_lost_samples_are_readings_that_did_not_arrive():
    """One sample in 40, as a radar loses cycles: a single segment, on the grid, with the samples that are there as they are."""
    lost = np.arange(30, len(logs.T) - 5, 40)
    lost = np.sort(np.concatenate([lost, [200 + 1, 200 + 2, 200 + 3]]))
    there = np.setdiff1d(np.arange(len(logs.T)), lost)
    columns = logs.GAP, logs.LEAD - logs.OWN, logs.OWN
    whole, found = checked(Raw("", logs.T, *columns), "file"), checked(Raw("", logs.T[there], *(x[there] for x in columns)), "file")
    ((one,), (two,)) = whole.segments, found.segments
    assert found.repairs == {"lost samples": len(lost)} and (np.flatnonzero(~two.seen) == lost).all()
    for a, b in zip(one[1:4], two[1:4], strict=True):
        assert np.abs(a - b)[there].max() < 1e-9
    assert np.abs(one.speed - two.speed).max() < 0.05
    few = np.flatnonzero(np.arange(len(logs.T)) % 7 < 3)
    with pytest.raises(InputError, match="missing or lost'; expected at most 50%"):
        checked(Raw("", logs.T[few], *(x[few] for x in columns)), "file")


def test_jitter_is_interpolated_and_short_segments_are_dropped():
    t = logs.T + 0.012 * np.sin(7.0 * np.arange(len(logs.T)))
    t[300:330] += 10.0
    t[330:] += 20.0
    found = checked(Raw("", t, logs.GAP, logs.LEAD - logs.OWN, logs.OWN), "file")
    assert found.repairs["holes in time"] == 2 and found.repairs["samples of short segments dropped"] == 30
    assert found.repairs["samples interpolated to even times"] == found.samples


def test_a_unit_of_another_kind_is_refused():
    for text, wanted in (("gap=d:km/h", "ft, km, m"), ("gap=d:s", "ft, km, m"), ("t=time:m", "ms, ns, s, us"), ("speed=v:ft", "ft/s, km/h, m/s, mph")):
        with pytest.raises(InputError, match=rf"--map: unit of {text.partition('=')[0]}: got '{text.rpartition(':')[2]}'.*{wanted}"):
            mapping_of([text])


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (Choice(lead="nobody"), "--lead: got 'nobody'; expected none: of these options the format trace takes --vehicle"),
        (Choice(length=4.0), "--length: got 4.0"), (Choice(mapping=(("t", "a", ""),)), "--map: got 't=a'"),
    ],
)  # fmt: skip
def test_an_option_that_the_format_does_not_have_is_refused(choice, words):
    with pytest.raises(InputError, match=re.escape(words)):
        read("asta-string", choice=choice)


def test_a_track_of_one_car_has_no_other():
    with pytest.raises(InputError, match="--vehicle: got '2'; expected none: comma2k19-radar has one car"):
        read("comma2k19-radar", choice=Choice(vehicle="2"))


def test_a_mapping_is_checked():
    assert mapping_of(["speed=v:km/h", "gap=d"]) == (("speed", "v", "km/h"), ("gap", "d", ""))
    for text, words in (("speed", "WHAT=COLUMN"), ("velocity=v", "--map: got 'velocity'"), ("gap=", "WHAT=COLUMN")):
        with pytest.raises(InputError, match=words):
            mapping_of([text])


# -- malformed files


def _line(text, number, new):
    rows = text.split("\n")
    rows[number] = new
    return "\n".join(rows)


def _column(text, column, change, head=0):
    """A CSV text with one column changed, from its first row on."""
    rows = [row.split(",") for row in text.strip("\n").split("\n")]
    at = rows[head].index(column)
    for i, row in enumerate(rows[head + 1 :]):
        row[at] = change(i, row[at])
    return "\n".join(",".join(row) for row in rows)


def _tables():
    """Malformed tables of three formats: name, kind, text and what the error has to say."""
    for kind, head, time, gap, own, lead in (
        ("openacc", 2, "Time", "IVS1", "Speed2", "Speed1"), ("ultra-av", 0, "Time_Index", "Space_Gap", "Speed_FAV", "Speed_LV"),
        ("csv", 0, "seconds", "distance_ft", "v_kmh", "lead_kmh"),
    ):  # fmt: skip
        text = logs.TEXTS[kind][1]()
        change = lambda column, f, text=text, head=head: _column(text, column, f, head)  # noqa: E731
        yield "empty", kind, "", "header|file"
        yield "header only", kind, "\n".join(text.split("\n")[: head + 1]), "samples: got 0"
        yield "ten rows", kind, "\n".join(text.split("\n")[: head + 11]), "samples: got 10; expected at least 20"
        yield "a word", kind, change(own, lambda i, x: "fast" if i == 99 else x), f"line {head + 101}, column {own}: got 'fast'; expected a number"
        yield "a formula", kind, change(gap, lambda i, x: "=1+1" if i == 5 else x), "expected a number"
        yield "a comma for a point", kind, _line(text, head + 40, text.split("\n")[head + 40] + ",5"), f"line {head + 41}: got .* cells"
        yield "a short row", kind, _line(text, head + 40, "1,2"), f"line {head + 41}: got '2 cells'"
        yield "an empty line", kind, _line(text, head + 40, ""), f"line {head + 41}: got 'an empty line'"
        yield "no own speed", kind, change(own, lambda i, x: "nan" if i == 7 else x), "own speed: got '1 that are no number'"
        yield "empty own speed", kind, change(own, lambda i, x: "" if i % 3 else x), "own speed: got '400 that are no number'"
        yield "infinite own speed", kind, change(own, lambda i, x: "inf" if i == 7 else x), "own speed"
        yield "no time", kind, change(time, lambda i, x: "" if i == 7 else x), "time: got '1 that are no number'"
        yield "time goes back", kind, change(time, lambda i, x: "3.0" if i == 300 else x), "time: got 3.0; expected a time not before"
        yield "time stands still", kind, change(time, lambda i, x: "1.0"), "time: got '599 repeated'"
        yield "time in milliseconds", kind, change(time, lambda i, x: f"{100.0 * i}"), "is the unit a second"
        yield "time in nanoseconds", kind, change(time, lambda i, x: f"{1e8 * i}"), "is the unit a second"
        yield "only holes", kind, change(time, lambda i, x: f"{0.1 * i + 9.0 * (i // 9)}"), "holes'"
        yield "speed beyond any car", kind, change(own, lambda i, x: "999"), "own speed: got .*expected 0 to 100 m/s"
        yield "speed backwards", kind, change(own, lambda i, x: f"-{x}"), "own speed"
        yield "gap of millimetres", kind, change(gap, lambda i, x: f"{1000.0 * float(x)}"), "gap: got .*is the unit a metre"
        yield "gaps missing", kind, change(gap, lambda i, x: "nan" if i % 5 else x), "gap: got '480 of 600 missing'"
        yield "gaps below 0", kind, change(gap, lambda i, x: f"-{x}"), "gap: got '600 of 600 missing'"
        yield "lead speed infinite", kind, change(lead, lambda i, x: "1e300"), "relative speed: got"
        yield "a column gone", kind, re.sub(rf"\b{gap}\b", "x", text, count=1), "header|unknown|column|expected"
        yield "names twice", kind, re.sub(rf"\b{lead}\b", own, text, count=1), "header|expected"
        yield "not text", kind, b"\xff\xfe\x00\x01" * 50, "expected"


def _structured():
    """Malformed XML and JSON Lines."""
    xml = logs.sumo()
    entity = '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>'
    bomb = '<!DOCTYPE a [<!ENTITY b "ha">' + "".join(f'<!ENTITY b{i} "{"&b;" * 9}">' for i in range(9)) + "]>"
    head = '<?xml version="1.0" encoding="UTF-8"?>'
    for name, text, words in (
        ("an entity", xml.replace(head, head + entity), "a document type"), ("a bomb", xml.replace(head, head + bomb), "a document type"),
        ("cut off", xml[:5000], "well-formed XML"), ("empty", "", "well-formed XML"), ("a page", "<html><body/></html>", "root element: got 'html'"),
        ("no vehicles", f"{head}<fcd-export></fcd-export>", "a vehicle behind another"),
        ("alone", re.sub(r".*id=\"lead\".*\n", "", xml), "a vehicle behind another"),
        ("time is a word", xml.replace('time="0.500"', 'time="soon"'), "timestep.time: got 'soon'"),
        ("no time", xml.replace('timestep time="0.500"', "timestep"), "timestep.time: got None"),
        ("speed is a word", xml.replace('speed="20', 'speed="x20', 1), "vehicle.speed"), ("no lane", xml.replace('lane="road_0" ', "", 1), "id, lane, pos and speed"),
        ("a vehicle twice", re.sub(r"(        <vehicle id=\"me\".*\n)", r"\1\1", xml, count=1), "twice at"),
        ("deep", f"{head}<fcd-export>" + "<a>" * 20 + "</a>" * 20 + "</fcd-export>", "nested elements"),
        ("two steps", xml[: xml.index("<timestep", 900)] + "</fcd-export>", "samples|vehicle"),
        ("another encoding", xml.replace("UTF-8", "no-such"), "well-formed XML"),
    ):  # fmt: skip
        yield name, "sumo-fcd", text, words
    lines = logs.veremi()
    rows = lines.split("\n")
    change = lambda i, **new: "\n".join([*rows[:i], json.dumps(json.loads(rows[i]) | new), *rows[i + 1 :]])  # noqa: E731
    for name, text, words in (
        ("empty", "", "messages of type 2: got 0"), ("not JSON", lines.replace("{", "[", 1), "line 1"), ("a list", "[1, 2]\n" + lines, "line 1: got 'list'"),
        ("NaN", change(4, rcvTime=1.0).replace('"rcvTime": 1.0', '"rcvTime": NaN', 1), "line 5"), ("time is a word", change(4, rcvTime="now"), "line 5: rcvTime"),
        ("time is true", change(4, rcvTime=True), "line 5: rcvTime"), ("place of one number", change(4, pos=[1.0]), "line 5: pos"),
        ("place of words", change(5, pos=["a", "b"]), "line 6: pos"), ("no speed", change(5, spd=None), "line 6: spd"),
        ("nobody sends", "\n".join(rows[::2]), "sender"), ("no own place", "\n".join(rows[1::2]), "messages of type 2: got 0"),
        ("a key twice", rows[0][:-1] + ', "type": 2}\n' + lines, "twice"), ("deep", "[" * 5000 + "\n" + lines, "line 1"),
        ("time goes back", "\n".join([rows[90], *rows]), "time"), ("cut off", lines[:30000], "JSON object"),
    ):  # fmt: skip
        yield name, "veremi", text, words


MALFORMED = [*_tables(), *_structured()]


@pytest.mark.parametrize("name, kind, text, words", MALFORMED, ids=[f"{kind}-{name}".replace(" ", "-") for name, kind, *_ in MALFORMED])
def test_a_malformed_file_is_one_clear_error(name, kind, text, words, tmp_path, capsys):
    path = _file(tmp_path, logs.TEXTS[kind][0], text)
    extra = [part for text in logs.MAP for part in ("--map", text)] if kind == "csv" else ["--format", kind]
    assert main(["detect-log", path, "--defence", "kf", *extra]) == 2
    out, error = capsys.readouterr()
    assert not out and error.startswith("tailgate: error: ") and error.count("\n") == 1 and len(error) < 700
    assert re.search(words, error), error


def test_there_are_a_hundred_malformed_files(tmp_path):
    assert len(MALFORMED) + len(FOLDERS) >= 100


FOLDERS = [
    ("no radar", lambda at: _rename(at / "radar"), "the folder of a segment"), ("no speed", lambda at: _rename(at / "speed"), "speed or car_speed"),
    ("no times", lambda at: _rename(at / "radar/t"), "readable"), ("few columns", lambda at: logs.save(at / "radar/value", np.zeros((600, 3))), r"radar/value"),
    ("objects", lambda at: logs.save(at / "radar/value", np.array([{"a": 1}] * 600, dtype=object)), "readable"),
    ("text", lambda at: logs.save(at / "radar/value", np.array([["a"] * 7] * 600)), "radar/value"),
    ("cut off", lambda at: (at / "radar/value").write_bytes((at / "radar/value").read_bytes()[:900]), "readable"),
    ("no array", lambda at: (at / "radar/t").write_bytes(b"hello"), "readable"),
    ("other lengths", lambda at: logs.save(at / "speed/t", logs.T[:-1]), "speed/t"), ("times fall", lambda at: logs.save(at / "speed/t", -logs.T), "speed/t"),
    ("three axes", lambda at: logs.save(at / "radar/value", np.zeros((600, 7, 2))), "radar/value"),
]  # fmt: skip


def _rename(path):
    path.rename(path.with_name("other" + path.suffix))


@pytest.mark.parametrize("name, change, words", FOLDERS, ids=[name.replace(" ", "-") for name, *_ in FOLDERS])
def test_a_malformed_folder_is_one_clear_error(name, change, words, tmp_path, capsys):
    change(logs.comma(tmp_path) / "processed_log" / "CAN")
    assert main(["detect-log", str(tmp_path), "--defence", "kf", "--format", "comma2k19"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and re.search(words, error), error


@pytest.mark.parametrize("change, words", [
    ({"relative_speed": logs.OWN - logs.LEAD}, "positive where the gap grows"), ({"relative_speed": 3.6 * (logs.LEAD - logs.OWN)}, "are the units m and m/s"),
    ({"t": np.zeros(600)}, "repeated"), ({"gap": np.full(600, 2e3)}, "is the unit a metre"),
])  # fmt: skip
def test_what_cannot_be_meant_is_refused(change, words):
    columns = {"t": logs.T, "gap": logs.GAP, "relative_speed": logs.LEAD - logs.OWN, "speed": logs.OWN} | change
    with pytest.raises(InputError, match=words):
        checked(Raw("a", *columns.values()), "file")


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        (["t=t", "gap=d", "speed=v", "lead_speed=w:km/h"], "m/s off the gap's rate"), (["t=t", "gap=d:furlong", "speed=v", "lead_speed=w"], "unit of d: got 'furlong'"),
        (["t=t", "gap=e", "speed=v", "lead_speed=w"], "column: got 'e'"), ([], "--map t=COLUMN --map gap=COLUMN"),
    ],
)  # fmt: skip
def test_units_that_cannot_be_meant_are_refused(tmp_path, mapping, words):
    """One speed in m/s and the other as km/h: the gap would close by 14 m a second, and it does not."""
    t = np.arange(0.0, 30.0, 0.1)
    lines = [f"{x:.2f},{30.0 + 0.2 * np.sin(x):.4f},20.0,{20.0 + 0.2 * np.cos(x):.4f}" for x in t]
    (tmp_path / "drive.csv").write_text("t,d,v,w\n" + "\n".join(lines))
    file = str(tmp_path / "drive.csv")
    with pytest.raises(InputError, match=re.escape(words)):
        read(file, choice=Choice(mapping=mapping_of(mapping)))
    assert read(file, choice=Choice(mapping=mapping_of(["t=t", "gap=d", "speed=v", "lead_speed=w"])))[0].samples == 300
