#!/usr/bin/env python3
"""Makes a cell model of a NASA PCoE 18650 from its first cycles: derive_nasa_cell.py CELL.csv.gz OUT.toml [--name NAME]

Reads only cycles 0 to LAST_CYCLE (a partial charge, five discharges, five charges). The model does not use the rest of
the life.
With one RC branch of fixed time constant, the voltage is linear in the table values:

    V(t) = sum_j OCV_j h_j(s) - sum_j R0_j h_j(s) I - sum_j R1_j u_j(t),   tau du_j/dt = h_j(s) I - u_j

Here s is the SOC, h_j the hat function of point j of its grid, I the current (positive = discharge) and u_j the current
of the branch at point j. One bounded least-squares problem therefore gives all tables. Between two anchors, the SOC is
counted in ampere-hours. The anchors are the end of every full charge (SOC 1) and the knee of each discharge (3.0 V
under load), which has the same SOC in all discharges. These anchors keep two errors out of the curves: the
cycle-to-cycle fade, and the charger's current-gain error (its ampere-hours exceed those of the discharge by 1 %). Needs
numpy and scipy.
"""
import argparse
import csv
import gzip

import numpy as np
from scipy.optimize import lsq_linear

LAST_CYCLE = 10           # cycle 9 is the fifth discharge, cycle 10 the charge after it
TAU_S = 60.0              # 30 to 120 s fit equally well, 10 and 300 s worse; a second branch does not improve the fit here
SOC_LEFT = 0.045          # SOC left at 2.7 V under 2 A in a new cell; the data end there, and OCV(0) = 2.7 V is extrapolated
KNEE_V = 3.0
MIN_SLOPE, TOP_SLOPE = 0.2, 1.0   # V per unit SOC; TOP_SLOPE above SOC 0.9, where slow relaxation would otherwise bend the curve down
VOLTAGE_MIN, VOLTAGE_MAX = 2.7, 4.2
SOC = np.array([0, .03, .045, .06, .075, .09, .105, .12, .14, .17, .2, .25, .3, .4, .5, .6, .7, .75, .8, .85, .9, .93, .96, .98, 1])
AGEING_SHIFT = 0.5        # not fitted because a new cell does not show it; between uniform shrinking (0) and pure lithium loss (1)
CHARGE_WEIGHT = 0.6       # per second, relative to discharge
SMOOTH_OCV, SMOOTH_R0, SMOOTH_R1 = 0.0005, 0.5, 0.02


def read_cycles(path):
    """[(type, time, current, voltage, temperature)]; the time is counted within each cycle."""
    rows = {}
    with gzip.open(path, "rt") as f:
        for r in csv.DictReader(f):
            k = int(r["cycle"])
            if k > LAST_CYCLE:
                break
            rows.setdefault((k, r["type"]), []).append(
                [float(r[n]) for n in ("time_s", "current_a", "voltage_v", "temperature_c")])
    return [(key[1], *np.array(rows[key]).T) for key in sorted(rows)]


def ampere_hours(t, i):
    return np.r_[0, np.cumsum(0.5 * (i[1:] + i[:-1]) * np.diff(t))] / 3600


def with_soc(cycles):
    """SOC of every sample. The first charge begins at an unknown SOC, so it is left out: it only fills the cell."""
    def knee(t, i, v):
        n = np.flatnonzero((v <= KNEE_V) & (i > 1))[0]
        q = ampere_hours(t, i)
        return q[n - 1] + (q[n] - q[n - 1]) * (v[n - 1] - KNEE_V) / (v[n - 1] - v[n])

    discharges = [c for c in cycles if c[0] == "discharge"]
    knees = [knee(*d[1:4]) for d in discharges]
    end = [np.interp(-2.7, -d[3][d[2] > 1], ampere_hours(*d[1:3])[d[2] > 1]) for d in discharges]
    beyond_knee = np.mean(np.array(end) - knees)
    capacity = (np.mean(knees) + beyond_knee) / (1 - SOC_LEFT)      # mean capacity of the first five discharges
    soc_knee = SOC_LEFT + beyond_knee / capacity
    out, left, n = [], None, 0
    for kind, t, i, v, temp in cycles[1:]:
        if kind == "discharge":
            s = 1 - ampere_hours(t, i) * (1 - soc_knee) / knees[n]
            left, n = s[-1], n + 1
        else:
            i = np.where(i > 0.5, 0, i)       # the charger's self test: a load pulse of 3 A for about 0.1 s
            q = -ampere_hours(t, i)
            s = left + (1 - left) * q / q[-1]
        out.append((kind, t, i, v, temp, s))
    return capacity, out


def hats(s):
    j = np.clip(np.searchsorted(SOC, s) - 1, 0, len(SOC) - 2)
    w = np.clip((s - SOC[j]) / (SOC[j + 1] - SOC[j]), 0, 1)
    h = np.zeros((len(s), len(SOC)))
    h[np.arange(len(s)), j], h[np.arange(len(s)), j + 1] = 1 - w, w
    return h


def second_difference(weight):
    d = np.zeros((len(SOC) - 2, len(SOC)))
    for r, (a, b) in enumerate(zip(np.diff(SOC)[:-1], np.diff(SOC)[1:])):
        d[r, r:r + 3] = weight * (a + b) / 2 * np.array([1 / a, -1 / a - 1 / b, 1 / b])
    return d


def fit(records):
    n = len(SOC)
    a, y, w, load = [], [], [], []
    for kind, t, i, v, temp, s in records:
        h, u = hats(s), np.zeros((len(t), n))
        for k in range(1, len(t)):            # every record begins at rest
            e = np.exp(-(t[k] - t[k - 1]) / TAU_S)
            u[k] = e * u[k - 1] + (1 - e) * (i[k] * h[k] + i[k - 1] * h[k - 1]) / 2
        keep = (v > 0.5) & (v < 5) & (np.abs(np.diff(i, prepend=i[0])) < 0.5)
        keep &= ~((kind == "discharge") & (i < 1) & (s < 0.5))    # skip the recovery after the cut-off, which is slower than one branch
        a.append(np.hstack([h, -h * i[:, None], -u]))
        y.append(v)
        w.append(np.sqrt(np.clip(np.gradient(t), 0, 20)) * keep * (1.0 if kind == "discharge" else CHARGE_WEIGHT))
        load.append(np.full(len(t), kind == "discharge"))
    a, y, w, load = np.vstack(a), np.concatenate(y), np.concatenate(w), np.concatenate(load)
    steps = np.eye(3 * n)
    steps[:n, :n] = np.tril(np.ones((n, n)))  # OCV as a sum of positive steps: monotone
    scale = np.linalg.norm(w)
    smooth = np.zeros((3 * (n - 2), 3 * n))
    for b, weight in enumerate((SMOOTH_OCV, SMOOTH_R0, SMOOTH_R1)):
        smooth[b * (n - 2):(b + 1) * (n - 2), b * n:(b + 1) * n] = second_difference(weight * scale)
    smooth[0] = 0                             # OCV may bend at the empty end
    low = np.r_[VOLTAGE_MIN - 1e-6, np.where(SOC[1:] > 0.9, TOP_SLOPE, MIN_SLOPE) * np.diff(SOC), np.full(2 * n, 0.005)]
    high = np.r_[VOLTAGE_MIN + 1e-6, np.full(n - 1, 1.0), np.full(2 * n, 1.0)]
    x = lsq_linear(np.vstack([a * w[:, None], smooth]) @ steps, np.r_[y * w, np.zeros(len(smooth))],
                   (low, high), max_iter=1000).x
    x = steps @ x
    e = y - a @ x
    def rms(m):
        return float(np.sqrt(np.sum((e * w)[m] ** 2) / np.sum(w[m] ** 2)))
    return x[:n], x[n:2 * n], x[2 * n:], rms(load), rms(~load), e, load


def fit_thermal(records, r_total):
    """(heat capacity, thermal resistance) from dT/dt = (I^2 R - (T - T_start)/Rth)/Cth, integrated over the discharges.
    Reversible heat is neglected, so the values are effective values for this load."""
    rows, rhs = [], []
    for kind, t, i, v, temp, s in records:
        if kind != "discharge":
            continue
        heat = np.r_[0, np.cumsum((i ** 2 * np.interp(s, SOC, r_total))[1:] * np.diff(t))]
        above = np.r_[0, np.cumsum((temp - temp[0])[1:] * np.diff(t))]
        rows.append(np.c_[heat, -above])
        rhs.append(temp - temp[0])
    (g, f), *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(rhs), rcond=None)
    return 1 / g, g / f


def main():
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("csv")
    p.add_argument("toml")
    p.add_argument("--name", default="NASA PCoE B0005")
    args = p.parse_args()
    capacity, records = with_soc(read_cycles(args.csv))
    ocv, r0, r1, rms_d, rms_c, _, _ = fit(records)
    cth, rth = fit_thermal(records, r0 + r1)
    def row(x, d):
        return "[" + ", ".join(f"{v:.{d}f}" for v in x) + "]"
    with open(args.toml, "w") as f:
        f.write(f'''# Written by tests/tools/derive_nasa_cell.py; do not edit by hand.
format = 1
name = "{args.name}"
chemistry = "Li-ion 18650 (cathode not published)"
rated_capacity_ah = 2.0
capacity_ah = {capacity:.4f}
ocv_ageing_shift = {AGEING_SHIFT}
voltage_min_v = {VOLTAGE_MIN}
voltage_max_v = {VOLTAGE_MAX}
[provenance]
source = "B. Saha, K. Goebel, Battery Data Set, NASA Ames Prognostics Data Repository (2007)"
method = "bounded least squares, one RC branch of {TAU_S:.0f} s, SOC by ampere-hours between full charges and the discharge knee; OCV slope held >= {TOP_SLOPE} V per unit above SOC 0.9"
data = "cycles 1 to {LAST_CYCLE}: five discharges at 2 A, five charges at 1.5 A to 4.2 V"
residual_rms_v = {rms_d:.4f}
residual_rms_charge_v = {rms_c:.4f}
[tables]
soc = {row(SOC, 3)}
temperature_c = [24]
ocv_v = [{row(ocv, 4)}]
r0_ohm = [{row(r0, 4)}]
[[tables.branches]]
r_ohm = [{row(r1, 4)}]
c_farad = [{row(TAU_S / r1, 1)}]
[thermal]
heat_capacity_j_per_k = {cth:.1f}
resistance_k_per_w = {rth:.2f}
''')


if __name__ == "__main__":
    main()
