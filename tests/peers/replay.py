"""Replays a log with Python libraries, for comparison with `packwatch replay`. python-can reads the frames, cantools
decodes them, and filterpy's UKF makes one step of a cell for each of its voltage readings.

replay.py LOG CONFIG SOCS      prints: frames steps seconds; writes the SOC after each step to SOCS, one number per line

The filter is that of src/core/cell/estimator.rs: states [SOC, U1, ln rho, C], with the same tables, circuit, process
and measurement noises (defaults of docs/src/reference/keys.md). filterpy's own class draws the sigma points, once
before the prediction and again before the update. These parts of packwatch are omitted: the gate (rejection of
implausible voltages), the consistency check, learning at the end of charges and discharges, alarms and sent frames.
"""
import bisect
import math
import sys
import time
import tomllib
from pathlib import Path

import can
import cantools
import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

# [estimator] of docs/src/reference/keys.md
ALPHA, BETA, KAPPA = 1.0, 2.0, 0.0
INITIAL_SOC_STD, INITIAL_BRANCH_STD_V, INITIAL_LOG_RESISTANCE_STD = 0.3, 0.05, 0.2
INITIAL_CAPACITY_STD = 0.1
SOC_NOISE, CHARGE_NOISE, BRANCH_NOISE_V, LOG_RESISTANCE_NOISE = 3e-5, 3e-3, 1e-3, 1e-3
VOLTAGE_NOISE_V, MODEL_ERROR_V, DROP_ERROR, LOAD_ERROR = 0.005, 0.15, 0.3, 0.5
LOAD_MEMORY_S, MAX_INFORMATION_S, REST_REPEATS_S, MAX_WALK_S = 1200.0, 100.0, 1000.0, 600.0
ACTIVATION_K = 25_000.0 / 8.314462618


def arrhenius(temperature_c):
    return math.exp(ACTIVATION_K * (1 / (temperature_c + 273.15) - 1 / 298.15))


class Model:
    """Tables over SOC for one temperature at a time."""

    def __init__(self, path):
        raw = tomllib.loads(path.read_text())
        tables = raw["tables"]
        (branch,) = tables["branches"]
        if raw.get("ocv_ageing_shift", 0) or "electrodes" in raw or "voltage_error_v" in tables:
            sys.exit("replay.py: ageing shift and error tables are not implemented here")
        self.rated_ah, self.capacity_ah = raw["rated_capacity_ah"], raw["capacity_ah"]
        self.soc, self.temperature_c = tables["soc"], tables["temperature_c"]
        self.ocv, self.r0, self.r1 = tables["ocv_v"], tables["r0_ohm"], branch["r_ohm"]
        self.tau = [[r * c for r, c in zip(*rows)] for rows in zip(branch["r_ohm"], branch["c_farad"])]
        self.rows = {}

    def at(self, temperature_c):
        """(OCV, R0, R1, tau) over SOC at a temperature. Cached because sensor values repeat."""
        if temperature_c not in self.rows:
            t = min(max(bisect.bisect_right(self.temperature_c, temperature_c) - 1, 0), len(self.temperature_c) - 2)
            low_c, high_c = self.temperature_c[t:t + 2]
            clamped = min(max(temperature_c, low_c), high_c)
            along = (clamped - low_c) / (high_c - low_c)
            cold, warm = arrhenius(low_c), arrhenius(high_c)
            resistance = (arrhenius(clamped) - cold) / (warm - cold)
            def mix(table, weight):
                return [a + weight * (b - a) for a, b in zip(table[t], table[t + 1])]
            self.rows[temperature_c] = (mix(self.ocv, along), mix(self.r0, resistance), mix(self.r1, resistance), mix(self.tau, along))
        return self.rows[temperature_c]

    def place(self, soc):
        """Index of the table interval, relative position in it, and this position limited to 0 to 1."""
        grid = self.soc
        s = min(max(bisect.bisect_right(grid, soc) - 1, 0), len(grid) - 2)
        beyond = (soc - grid[s]) / (grid[s + 1] - grid[s])
        return s, beyond, min(max(beyond, 0.0), 1.0)


def between(row, s, along):
    return row[s] + along * (row[s + 1] - row[s])


class Cell:
    def __init__(self, model, voltage_v, current_a, row):
        self.model, self.row, self.current_a, self.charge_as, self.dt_s = model, row, current_a, 0.0, 0.0
        points = MerweScaledSigmaPoints(4, ALPHA, BETA, KAPPA)
        self.ukf = ukf = UnscentedKalmanFilter(4, 1, 0.1, hx=self.hx, fx=self.fx, points=points)
        s, _, along = model.place(0.5)
        soc = self.soc_of_ocv(voltage_v + between(row[1], s, along) * current_a)
        ukf.x = np.array([soc, 0.0, 0.0, model.capacity_ah])
        deviations = [INITIAL_SOC_STD, INITIAL_BRANCH_STD_V, INITIAL_LOG_RESISTANCE_STD, INITIAL_CAPACITY_STD * model.capacity_ah]
        ukf.P = np.diag(np.square(deviations))
        ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
        self.information_s, self.rest_s, self.load_a = MAX_INFORMATION_S, 0.0, 0.0

    def soc_of_ocv(self, voltage_v):
        low, high = -0.5, 1.5
        for _ in range(40):
            middle = 0.5 * (low + high)
            s, beyond, _ = self.model.place(middle)
            low, high = (middle, high) if voltage_v > between(self.row[0], s, beyond) else (low, middle)
        return 0.5 * (low + high)

    def fx(self, x, dt):
        soc, branch_v, log_resistance, capacity_ah = x.tolist()
        next_soc = soc - self.charge_as / (3600 * capacity_ah)
        s, _, along = self.model.place(0.5 * (soc + next_soc))
        settled_v = between(self.row[2], s, along) * math.exp(log_resistance) * self.charge_as / dt
        decay = math.exp(-dt / between(self.row[3], s, along))
        return np.array([next_soc, settled_v + (branch_v - settled_v) * decay, log_resistance, capacity_ah])

    def hx(self, x):
        soc, branch_v, log_resistance, _ = x.tolist()
        s, beyond, along = self.model.place(soc)
        r0_v = between(self.row[1], s, along) * math.exp(log_resistance) * self.current_a
        return np.array([between(self.row[0], s, beyond) - branch_v - r0_v])

    def predict(self, dt_s, charge_as):
        soc, _, _, capacity_ah = self.ukf.x.tolist()
        s, _, along = self.model.place(soc)
        half_tau_s = 0.5 * between(self.row[3], s, along)
        self.charge_as = charge_as
        self.ukf.Q = np.diag([
            SOC_NOISE**2 * dt_s + CHARGE_NOISE**2 * abs(charge_as) / (3600 * capacity_ah),
            BRANCH_NOISE_V**2 * half_tau_s * -math.expm1(-dt_s / half_tau_s),
            LOG_RESISTANCE_NOISE**2 * min(dt_s, MAX_WALK_S),
            0.0,
        ])
        self.ukf.predict(dt=dt_s)

    def note_load(self, dt_s, charge_as):
        mean_a = abs(charge_as) / dt_s
        self.load_a = mean_a + (self.load_a - mean_a) * math.exp(-dt_s / LOAD_MEMORY_S)
        if abs(charge_as) > self.model.rated_ah / 50 * dt_s:
            self.rest_s = 0.0
            self.information_s += dt_s
        else:
            before_s, self.rest_s = self.rest_s, self.rest_s + dt_s
            self.information_s += REST_REPEATS_S * math.log((REST_REPEATS_S + self.rest_s) / (REST_REPEATS_S + before_s))

    def update(self, voltage_v):
        soc, branch_v, log_resistance, _ = self.ukf.x.tolist()
        s, _, along = self.model.place(soc)
        r0, ratio = between(self.row[1], s, along), math.exp(log_resistance)
        drop_v = r0 * ratio * self.current_a + branch_v
        load_v = (r0 + between(self.row[2], s, along)) * ratio * self.load_a
        model_variance = MODEL_ERROR_V**2 + (DROP_ERROR * drop_v)**2 + (LOAD_ERROR * load_v)**2
        information_s = min(max(self.information_s, 1e-3), MAX_INFORMATION_S)
        self.ukf.update(np.array([voltage_v]), R=VOLTAGE_NOISE_V**2 + model_variance / information_s)
        self.information_s = 0.0


class Pack:
    def __init__(self, path):
        config = tomllib.loads(path.read_text())
        self.model = Model(path.parent / config["pack"]["cell_model"])
        self.database = cantools.database.Database()
        for dbc in config["input"]["dbc"]:
            self.database.add_dbc_file(path.parent / dbc)
        count = config["pack"]["cells"]
        self.sign = -1.0 if config["input"]["current"]["positive"] == "charge" else 1.0
        self.current = config["input"]["current"]["signal"].split(".")[1]
        pattern = config["input"]["cell_voltage"]["signal"].split(".")[1]
        self.voltages = {pattern.format(n=n + 1): n for n in range(count)}
        self.sensors = {}
        for sensor in config["input"]["temperature"]:
            first, last = map(int, sensor["cells"].split("-"))
            self.sensors[sensor["signal"].split(".")[1]] = range(first - 1, last)
        self.temperature_c = [config["pack"]["ambient_c"]] * count
        self.cells, self.before = [None] * count, [None] * count
        self.current_a = self.current_at = None
        self.charge_as = 0.0
        self.max_age_s = config["limits"]["current"]["max_age_s"]
        self.socs = []

    def take(self, message):
        values = self.database.decode_message(message.arbitration_id, message.data, decode_choices=False)
        for name, value in values.items():
            if name in self.voltages:
                self.voltage(message.timestamp, self.voltages[name], value)
            elif name == self.current:
                self.flow(message.timestamp, self.sign * value)
            elif name in self.sensors:
                for cell in self.sensors[name]:
                    self.temperature_c[cell] = value

    def flow(self, time_s, current_a):
        """Adds the charge since the last reading, by the trapezoidal rule."""
        if self.current_at is not None:
            dt_s = time_s - self.current_at
            if dt_s > self.max_age_s:
                sys.exit("replay.py: a gap in the current is not implemented here")
            self.charge_as += 0.5 * (self.current_a + current_a) * dt_s
        self.current_a, self.current_at = current_a, time_s

    def voltage(self, time_s, index, voltage_v):
        cell, row = self.cells[index], self.model.at(self.temperature_c[index])
        charge_as = self.charge_as + self.current_a * (time_s - self.current_at)
        if cell is None:
            cell = self.cells[index] = Cell(self.model, voltage_v, self.current_a, row)
        else:
            before_s, before_as = self.before[index]
            cell.row, cell.current_a = row, self.current_a
            cell.predict(time_s - before_s, charge_as - before_as)
            cell.note_load(time_s - before_s, charge_as - before_as)
        cell.update(voltage_v)
        self.before[index] = time_s, charge_as
        self.socs.append(cell.ukf.x[0])


def main():
    log, config, socs = sys.argv[1:]
    pack = Pack(Path(config))
    frames, start = 0, time.perf_counter()
    for message in can.LogReader(log):
        pack.take(message)
        frames += 1
    print(frames, len(pack.socs), f"{time.perf_counter() - start:.6f}")
    Path(socs).write_text("".join(f"{soc!r}\n" for soc in map(float, pack.socs)))


main()
