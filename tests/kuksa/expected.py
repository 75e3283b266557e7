"""Computes the value that each output of the KUKSA provider must have, from the status document. Uses none of the
provider's code, so that signs, units and names are checked independently."""

import struct

STANDARD = "Vehicle.Powertrain.TractionBattery."
OVERLAY = STANDARD + "Packwatch."

# Battery signals of VSS itself (release 6), with their datatypes.
VSS = {
    "CurrentVoltage": "float", "CurrentCurrent": "float", "CurrentPower": "float",
    "Temperature.Average": "float", "Temperature.Min": "float", "Temperature.Max": "float", "Temperature.CellTemperature": "float[]",
    "CellVoltage.Min": "float", "CellVoltage.IdMin": "uint16", "CellVoltage.Max": "float", "CellVoltage.IdMax": "uint16",
    "CellVoltage.CellVoltages": "float[]", "StateOfCharge.Current": "float", "StateOfCharge.CurrentEnergy": "float",
    "Charging.TimeToComplete": "uint32", "StateOfHealth": "float", "ErrorCodes": "string[]",
    "TimeRemaining": "uint32", "AccumulatedChargedThroughput": "float", "AccumulatedConsumedThroughput": "float",
    "AccumulatedChargedEnergy": "float", "AccumulatedConsumedEnergy": "float", "TotalEnergyThroughput": "uint64",
    # Signals of VSS that packwatch does not provide.
    "NetCapacity": "uint16", "StateOfCharge.Displayed": "float", "Charging.IsCharging": "boolean", "Range": "uint32",
}
PERCENT = ("StateOfCharge.Current", "StateOfHealth", "StateOfCharge.Displayed")
NOT_PROVIDED = ("NetCapacity", "StateOfCharge.Displayed", "Charging.IsCharging", "Range")


def single(number):
    """The number rounded to a 32-bit float."""
    return None if number is None else struct.unpack("f", struct.pack("f", number))[0]


def scaled(number, factor):
    return None if number is None else single(number * factor)


def array(cells, key, factor=1.0):
    numbers = [scaled(cell[key], factor) for cell in cells]
    return None if None in numbers else numbers


def standard(document):
    pack, cells, alarms = document["pack"], document["cells"], document["alarms"]
    moved = pack["moved"] or {}
    volts, temperatures = array(cells, "voltage_v"), array(cells, "temperature_c")
    power = None if None in (pack["current_a"], pack["voltage_v"]) else single(-pack["current_a"] * pack["voltage_v"])
    raised = [alarm for alarm in alarms["list"] if alarm["state"] in ("active", "clearing", "suppressed", "latched")]
    codes = [f"{alarm['rule']}:{alarm['severity']}" + ("" if alarm["cell"] is None else f":cell{alarm['cell']}") for alarm in raised]
    if not codes and (alarms["unknown"] or alarms["thresholds"] == 0):
        codes = None
    celsius = [cell["temperature_c"] for cell in cells]
    return {
        "CurrentVoltage": single(pack["voltage_v"]),
        "CurrentCurrent": scaled(pack["current_a"], -1.0),
        "CurrentPower": power,
        "Temperature.Average": None if None in celsius else single(sum(celsius) / len(celsius)),
        "Temperature.Min": None if temperatures is None else min(temperatures),
        "Temperature.Max": single(pack["temperature_max_c"]),
        "Temperature.CellTemperature": temperatures,
        "CellVoltage.Min": None if volts is None else min(volts),
        "CellVoltage.IdMin": None if volts is None else volts.index(min(volts)),
        "CellVoltage.Max": None if volts is None else max(volts),
        "CellVoltage.IdMax": None if volts is None else volts.index(max(volts)),
        "CellVoltage.CellVoltages": volts,
        "StateOfCharge.Current": scaled(pack["soc"], 100.0),
        "StateOfCharge.CurrentEnergy": scaled(pack["remaining_energy_wh"], 1e-3),
        "Charging.TimeToComplete": None if pack["time_to_full_s"] is None else round(single(pack["time_to_full_s"])),
        "StateOfHealth": None if (pack["soh"] or 0) > 1 else scaled(pack["soh"], 100.0),
        "ErrorCodes": codes,
        "TimeRemaining": None if pack["time_to_empty_s"] is None else round(pack["time_to_empty_s"]),
        "AccumulatedChargedThroughput": single(moved.get("charged_ah")),
        "AccumulatedConsumedThroughput": single(moved.get("discharged_ah")),
        "AccumulatedChargedEnergy": scaled(moved.get("charged_wh"), 1e-3),
        "AccumulatedConsumedEnergy": scaled(moved.get("discharged_wh"), 1e-3),
        "TotalEnergyThroughput": round(moved["charged_wh"] + moved["discharged_wh"]) if moved else None,
    }


def overlay(document):
    pack, cells, alarms = document["pack"], document["cells"], document["alarms"]
    severity = alarms["highest_severity"]
    if severity is None and alarms["raised"] == 0 and alarms["thresholds"] > 0 and not alarms["unknown"]:
        severity = "none"
    flags = [cell["trusted"] for cell in cells]
    values = {
        "Validity": document["state"],
        "Mode": None if pack["mode"] == "unknown" else pack["mode"],
        "LimitingCell": pack["limiting_cell"],
        "WeakestCell": pack["weakest_cell"],
        "IsAsleep": document["asleep_since"] is not None,
        "RemainingLife.Cell": pack["shortest_lived_cell"],
        "RemainingLife.Time": single(pack["remaining_days"]),
        "CurrentSensor.Offset": scaled(pack["current_offset_a"], -1.0),
        "CurrentSensor.IsFrozen": None if pack["current_a"] is None else document["current_frozen"],
        "Model.State": pack["model_state"],
        "Model.BetterChemistry": pack["model_fits_better"],
        "Alarms.Thresholds": alarms["thresholds"],
        "Alarms.Raised": alarms["raised"],
        "Alarms.Unknown": len(alarms["unknown"]),
        "Alarms.HighestSeverity": severity,
        "Findings": finding_codes(document),
        "Cells.IsTrusted": None if None in flags else flags,
        "Cells.Current": array(cells, "current_a", -1.0),
    }
    values |= {name: single(pack[key]) for name, key in PACK_NUMBERS.items()}
    values |= {name: scaled(pack[key], 1e-3) for name, key in PACK_ENERGIES.items()}
    values |= {name: scaled(pack[key], 100.0) for name, key in PACK_PERCENT.items()}
    values |= {f"Cells.{name}": array(cells, key) for name, key in CELL_NUMBERS.items()}
    values |= {f"Cells.{name}": array(cells, key, 100.0) for name, key in CELL_PERCENT.items()}
    return values


def finding_codes(document):
    codes = []
    for finding in document["findings"]:
        cells = "" if finding["cells"] is None else "".join(f":cell{cell}" for cell in dict.fromkeys(finding["cells"]))
        codes.append(finding["kind"] + cells)
    return codes if codes or document["pack"]["soc"] is not None else None


PACK_NUMBERS = {
    "Capacity.Learned": "capacity_ah", "Capacity.LearnedStandardDeviation": "capacity_std_ah",
    "Capacity.Usable": "usable_capacity_ah", "Capacity.UsableStandardDeviation": "usable_capacity_std_ah",
    "RemainingLife.Cycles": "remaining_cycles", "RemainingLife.CyclesLow": "remaining_cycles_low",
    "RemainingLife.CyclesHigh": "remaining_cycles_high", "RechargePeriod.Last": "recharge_period_s",
    "RechargePeriod.Normalised": "normalised_recharge_period_s",
    "RechargePeriod.NormalisedStandardDeviation": "normalised_recharge_period_std_s",
    "CurrentSensor.OffsetStandardDeviation": "current_offset_std_a",
    "Charging.TimeToCompleteStandardDeviation": "time_to_full_std_s",
    "Energy.TimeToEmpty": "time_to_empty_s", "Energy.TimeToEmptyStandardDeviation": "time_to_empty_std_s",
    "Energy.TimeToTarget": "time_to_target_s", "Energy.TimeToTargetStandardDeviation": "time_to_target_std_s",
    "Use.LimitEvents": "limit_events", "Use.FastCharges": "fast_charges", "Use.HighSocTime": "high_soc_time_s",
} | {
    f"Power.{kind}{time}{name}": f"{kind.lower()}_power_{time}{key}_w" for kind in ("Discharge", "Charge")
    for time in ("2s", "10s", "30s") for name, key in (("", ""), ("StandardDeviation", "_std"))
}
PACK_ENERGIES = {
    "StateOfCharge.CurrentEnergyStandardDeviation": "remaining_energy_std_wh",
    "Energy.ToFull": "energy_to_full_wh", "Energy.ToFullStandardDeviation": "energy_to_full_std_wh",
}
PACK_PERCENT = {
    "StateOfCharge.CurrentStandardDeviation": "soc_std", "StateOfCharge.Low": "soc_low", "StateOfCharge.High": "soc_high",
    "StateOfCharge.Reported": "reported_soc", "StateOfHealth.Learned": "soh", "StateOfHealth.LearnedStandardDeviation": "soh_std", "StateOfHealth.Reported": "reported_soh",
    "StateOfHealth.Energy": "energy_soh", "StateOfHealth.EnergyStandardDeviation": "energy_soh_std",
    "Loss.LithiumInventory": "lli", "Loss.LithiumInventoryStandardDeviation": "lli_std",
    "Loss.NegativeElectrode": "lam_ne", "Loss.NegativeElectrodeStandardDeviation": "lam_ne_std",
    "Loss.PositiveElectrode": "lam_pe", "Loss.PositiveElectrodeStandardDeviation": "lam_pe_std",
}
CELL_NUMBERS = {
    "Capacity": "capacity_ah", "CapacityStandardDeviation": "capacity_std_ah", "UsableCapacity": "usable_capacity_ah",
    "UsableCapacityStandardDeviation": "usable_capacity_std_ah", "ResistanceRatio": "resistance_ratio",
    "ResistanceRatioStandardDeviation": "resistance_ratio_std", "RemainingCycles": "remaining_cycles",
    "RemainingCyclesLow": "remaining_cycles_low", "RemainingCyclesHigh": "remaining_cycles_high", "RemainingDays": "remaining_days",
}
CELL_PERCENT = {
    "StateOfCharge": "soc", "StateOfChargeStandardDeviation": "soc_std",
    "LithiumInventoryLoss": "lli", "LithiumInventoryLossStandardDeviation": "lli_std",
    "NegativeElectrodeLoss": "lam_ne", "NegativeElectrodeLossStandardDeviation": "lam_ne_std",
    "PositiveElectrodeLoss": "lam_pe", "PositiveElectrodeLossStandardDeviation": "lam_pe_std",
}


def outputs(document):
    """Returns the value of every output by its path; None = no value."""
    names = {STANDARD + name: value for name, value in standard(document).items()}
    return names | {OVERLAY + name: value for name, value in overlay(document).items()}
