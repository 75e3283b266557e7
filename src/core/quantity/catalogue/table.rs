//! Rows of the catalogue: keys, units, names and descriptions of every published quantity.

use super::VssPath::{Overlay, Standard};
use super::{Quantity, QuantityRow, Unit};
use Quantity as Q;
use QuantityRow as Row;

/// The catalogue, in the order of [`Quantity`].
pub static TABLE: [QuantityRow; 38] = [
    Row::estimate(Q::Soc, ("soc", "soc_std"), Unit::Level, "soc")
        .pack("State of charge of the limiting cell", ("SOC", "SoC"), Standard("StateOfCharge.Current"))
        .cell("State of charge", Some("cell_soc"), Overlay("Cells.StateOfCharge")),
    Row::number(Q::SocLow, "soc_low", Unit::Fraction, "soc_low").pack(
        "Lower end of the 95 % interval of the state of charge",
        ("SOC_low", "SoC 95 % Low"),
        Overlay("StateOfCharge.Low"),
    ),
    Row::number(Q::SocHigh, "soc_high", Unit::Fraction, "soc_high").pack(
        "Upper end of the 95 % interval of the state of charge",
        ("SOC_high", "SoC 95 % High"),
        Overlay("StateOfCharge.High"),
    ),
    Row::number(Q::ReportedSoc, "reported_soc", Unit::Level, "reported_soc").pack(
        "State of charge as the battery management system reports it",
        ("SOC_reported", "SoC (reported by the pack)"),
        Overlay("StateOfCharge.Reported"),
    ),
    Row::number(Q::Voltage, "voltage_v", Unit::Volts, "voltage")
        .pack("Sum of the cells' voltages", ("battery_voltage", "Battery Voltage"), Standard("CurrentVoltage"))
        .cell("Voltage", Some("cell_voltages"), Standard("CellVoltage.CellVoltages")),
    Row::number(Q::Current, "current_a", Unit::Amperes, "current")
        .pack("Current", ("battery_current", "Battery Current"), Standard("CurrentCurrent"))
        .cell("Current", None, Overlay("Cells.Current")),
    Row::estimate(Q::CurrentOffset, ("current_offset_a", "current_offset_std_a"), Unit::Amperes, "current_offset")
        .pack(
            "Learned offset of the current sensor: its reading minus the true current",
            ("battery_current_offset", "Battery Current Sensor Offset"),
            Overlay("CurrentSensor.Offset"),
        ),
    Row::number(Q::Temperature, "temperature_c", Unit::Celsius, "temperature").cell(
        "Temperature of the cell's sensor",
        Some("cell_temperatures"),
        Standard("Temperature.CellTemperature"),
    ),
    Row::number(Q::TemperatureMax, "temperature_max_c", Unit::Celsius, "temperature_max").pack(
        "Highest temperature, while all sensors are fresh",
        ("temperature_max", "Temperature Max"),
        Standard("Temperature.Max"),
    ),
    Row::estimate(Q::Capacity, ("capacity_ah", "capacity_std_ah"), Unit::AmpereHours, "capacity")
        .pack(
            "Lowest learned capacity of a cell, once the capacity of every cell was learned",
            ("capacity", "Capacity"),
            Overlay("Capacity.Learned"),
        )
        .cell(
            "Learned capacity between the open-circuit voltages of a full and an empty cell",
            Some("cell_capacity"),
            Overlay("Cells.Capacity"),
        ),
    Row::estimate(
        Q::UsableCapacity,
        ("usable_capacity_ah", "usable_capacity_std_ah"),
        Unit::AmpereHours,
        "usable_capacity",
    )
    .pack(
        "Usable capacity of the cell that has the least: charge from full to empty at the configured load",
        ("usable_capacity", "Usable Capacity"),
        Overlay("Capacity.Usable"),
    )
    .cell(
        "Charge that can be drawn from the full cell at the configured load",
        None,
        Overlay("Cells.UsableCapacity"),
    ),
    Row::estimate(Q::Soh, ("soh", "soh_std"), Unit::Level, "soh").pack(
        "Lowest learned capacity of a cell, divided by the rated capacity; may exceed 1",
        ("state_of_health", "State of Health"),
        Overlay("StateOfHealth.Learned"),
    ),
    Row::number(Q::ReportedSoh, "reported_soh", Unit::Level, "reported_soh").pack(
        "State of health as the battery management system reports it",
        ("state_of_health_reported", "State of Health (reported by the pack)"),
        Overlay("StateOfHealth.Reported"),
    ),
    Row::estimate(Q::ResistanceRatio, ("resistance_ratio", "resistance_ratio_std"), Unit::Ratio, "resistance").cell(
        "Resistance relative to new",
        Some("cell_resistance_ratio"),
        Overlay("Cells.ResistanceRatio"),
    ),
    Row::estimate(Q::LithiumLoss, ("lli", "lli_std"), Unit::Fraction, "lli")
        .pack(
            "Loss of lithium inventory of the cell with the least capacity, relative to a new cell",
            ("lithium_loss", "Loss of Lithium Inventory"),
            Overlay("Loss.LithiumInventory"),
        )
        .cell("Loss of lithium inventory, relative to a new cell", None, Overlay("Cells.LithiumInventoryLoss")),
    Row::estimate(Q::NegativeLoss, ("lam_ne", "lam_ne_std"), Unit::Fraction, "lam_ne")
        .pack(
            "Loss of active material of the negative electrode of the cell with the least capacity",
            ("negative_loss", "Loss of Negative Electrode"),
            Overlay("Loss.NegativeElectrode"),
        )
        .cell("Loss of active material of the negative electrode", None, Overlay("Cells.NegativeElectrodeLoss")),
    Row::estimate(Q::PositiveLoss, ("lam_pe", "lam_pe_std"), Unit::Fraction, "lam_pe")
        .pack(
            "Loss of active material of the positive electrode of the cell with the least capacity",
            ("positive_loss", "Loss of Positive Electrode"),
            Overlay("Loss.PositiveElectrode"),
        )
        .cell("Loss of active material of the positive electrode", None, Overlay("Cells.PositiveElectrodeLoss")),
    Row::number(Q::RemainingCycles, "remaining_cycles", Unit::Cycles, "remaining_cycles")
        .pack(
            "Equivalent full cycles until the first cell reaches its end of life, median",
            ("remaining_cycles", "Remaining Cycles"),
            Overlay("RemainingLife.Cycles"),
        )
        .cell("Equivalent full cycles until the end of life, median", None, Overlay("Cells.RemainingCycles")),
    Row::number(Q::RemainingCyclesLow, "remaining_cycles_low", Unit::Cycles, "remaining_cycles_low")
        .pack(
            "5 % quantile of the remaining cycles",
            ("remaining_cycles_low", "Remaining Cycles 5 %"),
            Overlay("RemainingLife.CyclesLow"),
        )
        .cell("5 % quantile of the remaining cycles", None, Overlay("Cells.RemainingCyclesLow")),
    Row::number(Q::RemainingCyclesHigh, "remaining_cycles_high", Unit::Cycles, "remaining_cycles_high")
        .pack(
            "95 % quantile of the remaining cycles",
            ("remaining_cycles_high", "Remaining Cycles 95 %"),
            Overlay("RemainingLife.CyclesHigh"),
        )
        .cell("95 % quantile of the remaining cycles", None, Overlay("Cells.RemainingCyclesHigh")),
    Row::number(Q::RemainingDays, "remaining_days", Unit::Days, "remaining_life")
        .pack(
            "Time until the first cell reaches its end of life at the recent use, median",
            ("remaining_days", "Remaining Days"),
            Overlay("RemainingLife.Time"),
        )
        .cell("Time until the end of life at the recent use, median", None, Overlay("Cells.RemainingDays")),
    Row::number(Q::RechargePeriod, "recharge_period_s", Unit::Seconds, "recharge_period").pack(
        "Last recorded recharge period",
        ("recharge_period", "Recharge Period"),
        Overlay("RechargePeriod.Last"),
    ),
    Row::estimate(
        Q::NormalisedRechargePeriod,
        ("normalised_recharge_period_s", "normalised_recharge_period_std_s"),
        Unit::Seconds,
        "recharge_period_normalised",
    )
    .pack(
        "Recharge period with the reference charger",
        ("normalised_recharge_period", "Normalised Recharge Period"),
        Overlay("RechargePeriod.Normalised"),
    ),
    Row::estimate(
        Q::RemainingEnergy,
        ("remaining_energy_wh", "remaining_energy_std_wh"),
        Unit::WattHours,
        "remaining_energy",
    )
    .pack(
        "Energy until the first cell is empty, at the recent load",
        ("remaining_energy", "Remaining Energy"),
        Standard("StateOfCharge.CurrentEnergy"),
    ),
    Row::estimate(Q::EnergyToFull, ("energy_to_full_wh", "energy_to_full_std_wh"), Unit::WattHours, "energy_to_full")
        .pack(
            "Energy that the pack takes up until the first cell is full",
            ("energy_to_full", "Energy to Full"),
            Overlay("Energy.ToFull"),
        ),
    Row::estimate(Q::EnergySoh, ("energy_soh", "energy_soh_std"), Unit::Level, "energy_soh").pack(
        "Energy of a discharge at C/2 of the cell with the least capacity, relative to a new cell",
        ("energy_state_of_health", "State of Health (energy)"),
        Overlay("StateOfHealth.Energy"),
    ),
    Row::estimate(Q::TimeToEmpty, ("time_to_empty_s", "time_to_empty_std_s"), Unit::Seconds, "time_to_empty").pack(
        "Time until the first cell is empty at the recent load, while the pack is discharged",
        ("time_to_empty", "Time to Empty"),
        Overlay("Energy.TimeToEmpty"),
    ),
    Row::estimate(Q::TimeToFull, ("time_to_full_s", "time_to_full_std_s"), Unit::Seconds, "time_to_full").pack(
        "Time until the first cell is full with the present charger, while the pack is charged",
        ("time_to_full", "Time to Full"),
        Standard("Charging.TimeToComplete"),
    ),
    Row::estimate(Q::TimeToTarget, ("time_to_target_s", "time_to_target_std_s"), Unit::Seconds, "time_to_target").pack(
        "Time until the configured state of charge, while the pack is charged",
        ("time_to_target", "Time to Target"),
        Overlay("Energy.TimeToTarget"),
    ),
    Row::power(Q::DischargePower2s, ("discharge_power_2s_w", "discharge_power_2s_std_w"), "discharge_power_2s").pack(
        "Power that can be drawn for 2 s within the limits of every cell",
        ("discharge_power_2s", "Discharge Power 2 s"),
        Overlay("Power.Discharge2s"),
    ),
    Row::power(Q::DischargePower10s, ("discharge_power_10s_w", "discharge_power_10s_std_w"), "discharge_power_10s")
        .pack(
            "Power that can be drawn for 10 s within the limits of every cell",
            ("discharge_power_10s", "Discharge Power 10 s"),
            Overlay("Power.Discharge10s"),
        ),
    Row::power(Q::DischargePower30s, ("discharge_power_30s_w", "discharge_power_30s_std_w"), "discharge_power_30s")
        .pack(
            "Power that can be drawn for 30 s within the limits of every cell",
            ("discharge_power_30s", "Discharge Power 30 s"),
            Overlay("Power.Discharge30s"),
        ),
    Row::power(Q::ChargePower2s, ("charge_power_2s_w", "charge_power_2s_std_w"), "charge_power_2s").pack(
        "Power that can be charged for 2 s within the limits of every cell",
        ("charge_power_2s", "Charge Power 2 s"),
        Overlay("Power.Charge2s"),
    ),
    Row::power(Q::ChargePower10s, ("charge_power_10s_w", "charge_power_10s_std_w"), "charge_power_10s").pack(
        "Power that can be charged for 10 s within the limits of every cell",
        ("charge_power_10s", "Charge Power 10 s"),
        Overlay("Power.Charge10s"),
    ),
    Row::power(Q::ChargePower30s, ("charge_power_30s_w", "charge_power_30s_std_w"), "charge_power_30s").pack(
        "Power that can be charged for 30 s within the limits of every cell",
        ("charge_power_30s", "Charge Power 30 s"),
        Overlay("Power.Charge30s"),
    ),
    Row::number(Q::LimitEvents, "limit_events", Unit::Count, "limit_events").pack(
        "Events in which a temperature, a cell voltage or the current was beyond its limit",
        ("limit_events", "Events beyond Limits"),
        Overlay("Use.LimitEvents"),
    ),
    Row::number(Q::FastCharges, "fast_charges", Unit::Count, "fast_charges").pack(
        "Charges with a mean C-rate above 1 C",
        ("fast_charges", "Fast Charges"),
        Overlay("Use.FastCharges"),
    ),
    Row::number(Q::HighSocTime, "high_soc_time_s", Unit::Seconds, "high_soc_time").pack(
        "Time at rest with a state of charge above 80 %",
        ("high_soc_time", "Rest at High SoC"),
        Overlay("Use.HighSocTime"),
    ),
];
