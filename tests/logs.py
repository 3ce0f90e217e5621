"""Recordings in every format that is read, made by the tests: a car behind another for 60 s."""

import csv
import io
import json

import numpy as np

from tailgate.roads.fcd import fcd

T = 0.1 * np.arange(600)
LEAD = 20.0 + 2.0 * np.sin(0.3 * T)
OWN = 20.0 + 2.0 * np.sin(0.3 * (T - 1.2))
X_LEAD, X_OWN = (np.concatenate([[0.0], np.cumsum(0.05 * (v[1:] + v[:-1]))]) for v in (LEAD, OWN))
GAP = 27.0 + X_LEAD - X_OWN


def table(**columns):
    """A CSV file as text."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*([f"{x:.9g}" if isinstance(x, float) else x for x in column] for column in map(list, columns.values())), strict=True))
    return out.getvalue()


def openacc():
    head = "Date,07-05-2019\nSpecs,x\n"
    return head + table(Time=T, Speed1=LEAD, Speed2=OWN, IVS1=GAP)


def ultra_av():
    return table(
        Trajectory_ID=["7"] * len(T), Time_Index=T, ID_LV=["1"] * len(T), Speed_LV=LEAD, Speed_FAV=OWN, Space_Gap=GAP, Speed_Diff=LEAD - OWN
    )


def plain():
    return table(seconds=T, distance_ft=GAP / 0.3048, v_kmh=3.6 * OWN, lead_kmh=3.6 * LEAD)


MAP = ["t=seconds", "gap=distance_ft:ft", "speed=v_kmh:km/h", "lead_speed=lead_kmh:km/h"]


def sumo():
    place = np.stack([X_LEAD + 27.0 + 5.0, X_OWN, X_OWN + 0 * T], axis=1)[:, :2]
    return fcd(0.1, ["lead", "me"], place, np.stack([LEAD, OWN], axis=1), np.zeros((len(T), 2))).decode()


def veremi():
    lines = []
    for k in range(len(T)):
        lines.append({"type": 2, "rcvTime": T[k], "pos": [X_OWN[k], 3.0, 0.0], "spd": [OWN[k], 0.0, 0.0]})
        lines.append({"type": 3, "rcvTime": T[k], "sender": 9, "pos": [X_LEAD[k] + 32.0, 3.0, 0.0], "spd": [LEAD[k], 0.0, 0.0]})
    return "\n".join(json.dumps(line) for line in lines)


def save(path, array):
    """An array under exactly this name: files of comma2k19 have no suffix."""
    with path.open("wb") as file:
        np.lib.format.write_array(file, array, allow_pickle=True)


def comma(folder, columns=7, dtype=np.float64):
    """A segment's folder; returns it."""
    can = folder / "processed_log" / "CAN"
    for part, values in (("radar", None), ("speed", OWN)):
        (can / part).mkdir(parents=True, exist_ok=True)
        if values is None:
            values = np.zeros((len(T), columns), dtype)
            values[:, 0], values[:, 2] = GAP, LEAD - OWN
            values[:, 5 if columns > 5 else 0] = 535
        save(can / part / "t", T)
        save(can / part / "value", values)
    return folder


TEXTS = {"openacc": ("a.csv", openacc), "ultra-av": ("a.csv", ultra_av), "csv": ("a.csv", plain), "sumo-fcd": ("a.xml", sumo), "veremi": ("a.jsonl", veremi)}
