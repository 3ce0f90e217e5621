"""Measures root-MUSIC's error on one tone in noise, and fits what the closed-form path of the radar draws in its place.

    python benchmarks/results/radar_path/radar_path.py [--runs 4000] [--out FILE]

Against the SNR x after integration (the sample's times M): the share of outliers, which miss by more than 4/M cycles per sample, and the
variance of the others over the Cramer-Rao bound. The fit is made at M = 512, the default; the other sizes show how far it holds.
"""

from typing import Any

import numpy as np
from scipy import optimize

from tailgate.bench.study import arguments, made_by, write_record
from tailgate.envs.sensors import fmcw
from tailgate.envs.sensors.fmcw_signal import root_music

SIZES = {512: range(-6, 41, 1), 128: range(-6, 41, 4), 1024: range(-6, 41, 4)}  # samples of a sweep: x [dB]
FITTED = 512
NEAR_THE_BOUND = 14.0  # [dB] from here on outliers are rarer than 1 in 100: the variance is fitted


def measure(count: int, db: float, runs: int, rng: np.random.Generator) -> dict[str, Any]:
    """Outliers and variance at one SNR, over random frequencies and phases."""
    x, cell = 10.0 ** (db / 10.0), fmcw._CELL / count
    f = rng.uniform(-0.5, 0.5, (runs, 1))
    tone = np.sqrt(x / count) * np.exp(2j * np.pi * (f * np.arange(count) + rng.uniform(size=(runs, 1))))
    noise = np.sqrt(0.5) * (rng.standard_normal((runs, count)) + 1j * rng.standard_normal((runs, count)))
    off = (root_music(tone + noise) - f[:, 0] + 0.5) % 1.0 - 0.5
    far = np.abs(off) > cell
    bound = 6.0 / (4.0 * np.pi**2 * x * (count**2 - 1))
    near = off[~far]
    return {
        "snr_db": db, "runs": runs, "far": int(far.sum()), "outliers": round(float(far.mean()) / (1.0 - 2.0 * cell), 5),
        "over_bound": round(float(np.mean(near**2) / bound), 4) if len(near) > runs // 10 else None,
    }  # fmt: skip


def fit(rows: list[dict[str, Any]]) -> dict[str, list[float]]:
    """Maximum likelihood of the outliers' odds, and least squares of the relative error of the variance."""
    x = np.array([10.0 ** (row["snr_db"] / 10.0) for row in rows])
    runs, far = (np.array([row[name] for row in rows], float) for name in ("runs", "far"))
    seen = 1.0 - 2.0 * fmcw._CELL / FITTED  # of the outliers; the others fall next to the tone by chance

    def loss(o: Any) -> float:
        p = np.clip(seen / (1.0 + np.exp(np.minimum(o[1] * np.log(x) + o[2] * x - o[0], 700.0))), 1e-300, 1.0)
        return -float(np.sum(far * np.log(p) + (runs - far) * np.log1p(-p)))

    odds = optimize.minimize(loss, [4.0, 1.0, 0.2], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-6, "maxiter": 10_000}).x
    held = [(10.0 ** (-row["snr_db"] / 10.0), row["over_bound"]) for row in rows if row["snr_db"] >= NEAR_THE_BOUND]
    inverse, over = np.array(held).T
    e = np.linalg.lstsq(np.stack([np.ones_like(over), inverse, inverse**2], axis=1) / over[:, None], np.ones_like(over), rcond=None)[0]
    return {"outlier": [round(float(v), 3) for v in odds], "efficiency": [round(float(v), 2) for v in (e[0], e[1] / e[0], e[2] / e[0])]}


def main() -> None:
    parser = arguments(__file__, __doc__)
    parser.add_argument("--runs", type=int, default=4000)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for count, grid in SIZES.items():
        rng = np.random.default_rng(count)
        found[str(count)] = [measure(count, float(db), options.runs if count == FITTED else options.runs // 4, rng) for db in grid]
        print(f"\n{count} samples a sweep\n{'x [dB]':>8}{'outliers':>10}{'drawn':>10}{'variance':>10}{'drawn':>10}")
        link = fmcw.Link(bandwidth=count / fmcw.Link().sweep_time)
        for row in found[str(count)]:
            x = 10.0 ** (row["snr_db"] / 10.0)
            bound = 6.0 / (4.0 * np.pi**2 * x * (count**2 - 1))
            drawn = float(fmcw.tone_sd(link, np.array(x))) ** 2 / link.bandwidth**2 / bound
            over = "-" if row["over_bound"] is None else f"{row['over_bound']:.2f}"
            print(f"{row['snr_db']:>8.0f}{row['outliers']:>10.4f}{float(fmcw.outlier_probability(np.array(x))):>10.4f}{over:>10}{drawn:>10.2f}")
    constants = fit(found[str(FITTED)])
    print("\nfitted:", constants, " in use:", {"outlier": fmcw._OUTLIER, "efficiency": fmcw._EFFICIENCY})
    write_record(options.out, made_by("numpy", "scipy") | {"fitted": constants, "samples": found})


if __name__ == "__main__":
    main()
