//! Signals of the overlay: what VSS has no name for.
//!
//! Booleans begin with `Is`, as VSS asks. No unit is a temperature's: its name changed from VSS 5 to 6. None has a list of allowed
//! values: the databroker (0.7) compares it with "no value" too, and the last value would stay.

use packwatch_host::quantity::Mode;
use packwatch_host::status::document::{CellStatus, StatusDocument};

use super::super::value::{DataType, Value, single};
use super::{Origin, Signal, are_judged, cells, float, in_order, negated, number, percent, word};

const fn signal(
    name: &'static str,
    data_type: DataType,
    unit: Option<&'static str>,
    fields: &'static str,
    value: fn(&StatusDocument) -> Option<Value>,
    description: &'static str,
) -> Signal {
    Signal { name, origin: Origin::Overlay, data_type, unit, description, fields, value }
}

pub(super) static SIGNALS: &[Signal] = &[
    signal(
        "Validity",
        DataType::Text,
        None,
        "state",
        |status| word(Some(status.state)),
        "Whether the estimates can be used: unavailable, valid, degraded (coasting on stale inputs) or untrusted (the readings contradict the model).",
    ),
    signal(
        "Mode",
        DataType::Text,
        None,
        "pack.mode",
        |status| (status.pack.mode != Mode::Unknown).then(|| word(Some(status.pack.mode))).flatten(),
        "What the pack does, by its current: charge, rest or discharge. Braking into the battery is charge too.",
    ),
    signal(
        "LimitingCell",
        DataType::Uint16,
        None,
        "pack.limiting_cell",
        |status| number(status.pack.limiting_cell),
        "Cell that ends a discharge, counted from 0.",
    ),
    signal(
        "WeakestCell",
        DataType::Uint16,
        None,
        "pack.weakest_cell",
        |status| number(status.pack.weakest_cell),
        "Cell with the least capacity, counted from 0.",
    ),
    signal(
        "IsAsleep",
        DataType::Flag,
        None,
        "asleep_since",
        |status| Some(Value::Flag(status.asleep_since.is_some())),
        "True while the buses sleep.",
    ),
    signal(
        "StateOfCharge.StandardDeviation",
        DataType::Float,
        Some("percent"),
        "pack.soc_std",
        |status| percent(status.pack.soc_std),
        "Standard deviation of the state of charge.",
    ),
    signal(
        "StateOfCharge.Low",
        DataType::Float,
        Some("percent"),
        "pack.soc_low",
        |status| percent(status.pack.soc_low),
        "Lower end of the 95 % interval of the state of charge.",
    ),
    signal(
        "StateOfCharge.High",
        DataType::Float,
        Some("percent"),
        "pack.soc_high",
        |status| percent(status.pack.soc_high),
        "Upper end of the 95 % interval of the state of charge.",
    ),
    signal(
        "StateOfCharge.Reported",
        DataType::Float,
        Some("percent"),
        "pack.reported_soc",
        |status| percent(status.pack.reported_soc),
        "State of charge as the battery management system reports it.",
    ),
    signal(
        "StateOfHealth.Learned",
        DataType::Float,
        Some("percent"),
        "pack.soh",
        |status| percent(status.pack.soh),
        "Learned capacity over rated capacity. May exceed 100, unlike the standard StateOfHealth.",
    ),
    signal(
        "StateOfHealth.Reported",
        DataType::Float,
        Some("percent"),
        "pack.reported_soh",
        |status| percent(status.pack.reported_soh),
        "State of health as the battery management system reports it.",
    ),
    signal(
        "Capacity.Learned",
        DataType::Float,
        Some("Ah"),
        "pack.capacity_ah",
        |status| float(status.pack.capacity_ah),
        "Least capacity of a cell between its open-circuit voltages full and empty, once that of every cell was learned.",
    ),
    signal(
        "Capacity.LearnedStandardDeviation",
        DataType::Float,
        Some("Ah"),
        "pack.capacity_std_ah",
        |status| float(status.pack.capacity_std_ah),
        "Standard deviation of Capacity.Learned.",
    ),
    signal(
        "Capacity.Usable",
        DataType::Float,
        Some("Ah"),
        "pack.usable_capacity_ah",
        |status| float(status.pack.usable_capacity_ah),
        "Least charge that can be drawn from a full cell at the configured load.",
    ),
    signal(
        "Capacity.UsableStandardDeviation",
        DataType::Float,
        Some("Ah"),
        "pack.usable_capacity_std_ah",
        |status| float(status.pack.usable_capacity_std_ah),
        "Standard deviation of Capacity.Usable.",
    ),
    signal(
        "Loss.LithiumInventory",
        DataType::Float,
        Some("percent"),
        "pack.lli",
        |status| percent(status.pack.losses.lli),
        "Lost lithium inventory of the cell with the least capacity, part of a new cell's.",
    ),
    signal(
        "Loss.LithiumInventoryStandardDeviation",
        DataType::Float,
        Some("percent"),
        "pack.lli_std",
        |status| percent(status.pack.losses.lli_std),
        "Standard deviation of Loss.LithiumInventory.",
    ),
    signal(
        "Loss.NegativeElectrode",
        DataType::Float,
        Some("percent"),
        "pack.lam_ne",
        |status| percent(status.pack.losses.lam_ne),
        "Lost active material of the negative electrode of the cell with the least capacity, part of a new cell's.",
    ),
    signal(
        "Loss.NegativeElectrodeStandardDeviation",
        DataType::Float,
        Some("percent"),
        "pack.lam_ne_std",
        |status| percent(status.pack.losses.lam_ne_std),
        "Standard deviation of Loss.NegativeElectrode.",
    ),
    signal(
        "Loss.PositiveElectrode",
        DataType::Float,
        Some("percent"),
        "pack.lam_pe",
        |status| percent(status.pack.losses.lam_pe),
        "Lost active material of the positive electrode of the cell with the least capacity, part of a new cell's.",
    ),
    signal(
        "Loss.PositiveElectrodeStandardDeviation",
        DataType::Float,
        Some("percent"),
        "pack.lam_pe_std",
        |status| percent(status.pack.losses.lam_pe_std),
        "Standard deviation of Loss.PositiveElectrode.",
    ),
    signal(
        "RemainingLife.Cell",
        DataType::Uint16,
        None,
        "pack.shortest_lived_cell",
        |status| number(status.pack.shortest_lived_cell),
        "Cell whose life ends first, counted from 0.",
    ),
    signal(
        "RemainingLife.Cycles",
        DataType::Float,
        None,
        "pack.remaining_cycles",
        |status| float(status.pack.remaining.remaining_cycles),
        "Equivalent full cycles until the end of life of that cell, median.",
    ),
    signal(
        "RemainingLife.CyclesLow",
        DataType::Float,
        None,
        "pack.remaining_cycles_low",
        |status| float(status.pack.remaining.remaining_cycles_low),
        "5 % quantile of RemainingLife.Cycles.",
    ),
    signal(
        "RemainingLife.CyclesHigh",
        DataType::Float,
        None,
        "pack.remaining_cycles_high",
        |status| float(status.pack.remaining.remaining_cycles_high),
        "95 % quantile of RemainingLife.Cycles.",
    ),
    signal(
        "RemainingLife.Time",
        DataType::Float,
        Some("day"),
        "pack.remaining_days",
        |status| float(status.pack.remaining.remaining_days),
        "Days until the end of life at the recent use, median.",
    ),
    signal(
        "RechargePeriod.Last",
        DataType::Float,
        Some("s"),
        "pack.recharge_period_s",
        |status| float(status.pack.recharge_period_s),
        "Last recorded recharge period.",
    ),
    signal(
        "RechargePeriod.Normalised",
        DataType::Float,
        Some("s"),
        "pack.normalised_recharge_period_s",
        |status| float(status.pack.normalised_recharge_period_s),
        "Recharge period with the reference charger.",
    ),
    signal(
        "RechargePeriod.NormalisedStandardDeviation",
        DataType::Float,
        Some("s"),
        "pack.normalised_recharge_period_std_s",
        |status| float(status.pack.normalised_recharge_period_std_s),
        "Standard deviation of RechargePeriod.Normalised.",
    ),
    signal(
        "CurrentSensor.Offset",
        DataType::Float,
        Some("A"),
        "pack.current_offset_a",
        |status| float(negated(status.pack.current_offset_a)),
        "What the sensor reads less the true current, positive = into the battery.",
    ),
    signal(
        "CurrentSensor.OffsetStandardDeviation",
        DataType::Float,
        Some("A"),
        "pack.current_offset_std_a",
        |status| float(status.pack.current_offset_std_a),
        "Standard deviation of CurrentSensor.Offset.",
    ),
    signal(
        "CurrentSensor.IsFrozen",
        DataType::Flag,
        None,
        "current_frozen",
        |status| status.pack.current_a.map(|_| Value::Flag(status.current_frozen)),
        "True when the reading stays at one value while the voltages show another load.",
    ),
    signal(
        "Model.State",
        DataType::Text,
        None,
        "pack.model_state",
        |status| word(status.pack.model_state),
        "How well the cells' model is known: prior, learning, learned, unfit (another chemistry explains the voltages better) or given.",
    ),
    signal(
        "Model.BetterChemistry",
        DataType::Text,
        None,
        "pack.model_fits_better",
        |status| status.pack.model_fits_better.map(|chemistry| Value::Text(chemistry.name().to_owned())),
        "Chemistry that explains the voltages better than the configured one; no value = none does.",
    ),
    signal(
        "Alarms.Thresholds",
        DataType::Uint16,
        None,
        "alarms.thresholds",
        |status| number(Some(status.alarms.thresholds)),
        "Thresholds configured.",
    ),
    signal(
        "Alarms.Raised",
        DataType::Uint16,
        None,
        "alarms.raised",
        |status| number(Some(status.alarms.raised)),
        "Alarms raised now.",
    ),
    signal(
        "Alarms.Unknown",
        DataType::Uint16,
        None,
        "alarms.unknown",
        |status| number(Some(status.alarms.unknown.len())),
        "Thresholds that cannot be judged, because their value is not known.",
    ),
    signal(
        "Alarms.HighestSeverity",
        DataType::Text,
        None,
        "alarms.highest_severity",
        highest_severity,
        "Of the raised alarms: info, warning or severe; none only when every threshold was judged.",
    ),
    signal(
        "Findings",
        DataType::Texts,
        None,
        "findings",
        findings,
        "What is found of single cells and of the sensors, KIND, KIND:cell3 or KIND:cell3:cell7 (first and last cell, or the two of a pair). Empty = nothing reported.",
    ),
    signal(
        "Cells.StateOfCharge",
        DataType::Floats,
        None,
        "cells.soc",
        |status| percent_of_cells(status, |cell| cell.soc),
        "Percent, each cell.",
    ),
    signal(
        "Cells.StateOfChargeStandardDeviation",
        DataType::Floats,
        None,
        "cells.soc_std",
        |status| percent_of_cells(status, |cell| cell.soc_std),
        "Percent, each cell.",
    ),
    signal(
        "Cells.Current",
        DataType::Floats,
        None,
        "cells.current_a",
        |status| cells(status, |cell| negated(cell.current_a)),
        "A, each cell, positive = into the battery.",
    ),
    signal(
        "Cells.Capacity",
        DataType::Floats,
        None,
        "cells.capacity_ah",
        |status| cells(status, |cell| cell.capacity_ah),
        "Learned capacity in Ah, each cell.",
    ),
    signal(
        "Cells.CapacityStandardDeviation",
        DataType::Floats,
        None,
        "cells.capacity_std_ah",
        |status| cells(status, |cell| cell.capacity_std_ah),
        "Ah, each cell.",
    ),
    signal(
        "Cells.UsableCapacity",
        DataType::Floats,
        None,
        "cells.usable_capacity_ah",
        |status| cells(status, |cell| cell.usable_capacity_ah),
        "Ah at the configured load, each cell.",
    ),
    signal(
        "Cells.UsableCapacityStandardDeviation",
        DataType::Floats,
        None,
        "cells.usable_capacity_std_ah",
        |status| cells(status, |cell| cell.usable_capacity_std_ah),
        "Ah, each cell.",
    ),
    signal(
        "Cells.ResistanceRatio",
        DataType::Floats,
        None,
        "cells.resistance_ratio",
        |status| cells(status, |cell| cell.resistance_ratio),
        "Resistance relative to new, each cell.",
    ),
    signal(
        "Cells.ResistanceRatioStandardDeviation",
        DataType::Floats,
        None,
        "cells.resistance_ratio_std",
        |status| cells(status, |cell| cell.resistance_ratio_std),
        "Each cell.",
    ),
    signal(
        "Cells.LithiumInventoryLoss",
        DataType::Floats,
        None,
        "cells.lli",
        |status| percent_of_cells(status, |cell| cell.losses.lli),
        "Percent of a new cell's, each cell.",
    ),
    signal(
        "Cells.LithiumInventoryLossStandardDeviation",
        DataType::Floats,
        None,
        "cells.lli_std",
        |status| percent_of_cells(status, |cell| cell.losses.lli_std),
        "Percent, each cell.",
    ),
    signal(
        "Cells.NegativeElectrodeLoss",
        DataType::Floats,
        None,
        "cells.lam_ne",
        |status| percent_of_cells(status, |cell| cell.losses.lam_ne),
        "Percent of a new cell's, each cell.",
    ),
    signal(
        "Cells.NegativeElectrodeLossStandardDeviation",
        DataType::Floats,
        None,
        "cells.lam_ne_std",
        |status| percent_of_cells(status, |cell| cell.losses.lam_ne_std),
        "Percent, each cell.",
    ),
    signal(
        "Cells.PositiveElectrodeLoss",
        DataType::Floats,
        None,
        "cells.lam_pe",
        |status| percent_of_cells(status, |cell| cell.losses.lam_pe),
        "Percent of a new cell's, each cell.",
    ),
    signal(
        "Cells.PositiveElectrodeLossStandardDeviation",
        DataType::Floats,
        None,
        "cells.lam_pe_std",
        |status| percent_of_cells(status, |cell| cell.losses.lam_pe_std),
        "Percent, each cell.",
    ),
    signal(
        "Cells.RemainingCycles",
        DataType::Floats,
        None,
        "cells.remaining_cycles",
        |status| cells(status, |cell| cell.remaining.remaining_cycles),
        "Equivalent full cycles until the end of life, median, each cell.",
    ),
    signal(
        "Cells.RemainingCyclesLow",
        DataType::Floats,
        None,
        "cells.remaining_cycles_low",
        |status| cells(status, |cell| cell.remaining.remaining_cycles_low),
        "5 % quantile, each cell.",
    ),
    signal(
        "Cells.RemainingCyclesHigh",
        DataType::Floats,
        None,
        "cells.remaining_cycles_high",
        |status| cells(status, |cell| cell.remaining.remaining_cycles_high),
        "95 % quantile, each cell.",
    ),
    signal(
        "Cells.RemainingDays",
        DataType::Floats,
        None,
        "cells.remaining_days",
        |status| cells(status, |cell| cell.remaining.remaining_days),
        "Days until the end of life at the recent use, median, each cell.",
    ),
    signal(
        "Cells.IsTrusted",
        DataType::Flags,
        None,
        "cells.trusted",
        trusted,
        "Whether the filter of the cell is consistent, each cell.",
    ),
];

fn highest_severity(status: &StatusDocument) -> Option<Value> {
    let severity = status.alarms.highest_severity.map(|severity| severity.name());
    let none = (status.alarms.raised == 0 && are_judged(status)).then_some("none");
    severity.or(none).map(|word| Value::Text(word.to_owned()))
}

/// Without estimates nothing is looked for: an empty list would look healthy.
fn findings(status: &StatusDocument) -> Option<Value> {
    let codes: Vec<String> = status
        .findings
        .iter()
        .map(|finding| match finding.cells {
            None => finding.kind.name().to_owned(),
            Some((first, last)) if first == last => format!("{}:cell{}", finding.kind.name(), first.0),
            Some((first, last)) => format!("{}:cell{}:cell{}", finding.kind.name(), first.0, last.0),
        })
        .collect();
    (!codes.is_empty() || status.pack.soc.is_some()).then_some(Value::Texts(codes))
}

fn percent_of_cells(status: &StatusDocument, fraction: fn(&CellStatus) -> Option<f64>) -> Option<Value> {
    let percent = |cell: &CellStatus| single(fraction(cell).map(|fraction| 100.0 * fraction));
    let numbers: Option<Vec<f32>> = in_order(status)?.iter().map(percent).collect();
    numbers.filter(|numbers| !numbers.is_empty()).map(Value::Floats)
}

fn trusted(status: &StatusDocument) -> Option<Value> {
    let flags: Option<Vec<bool>> = in_order(status)?.iter().map(|cell| cell.trusted).collect();
    flags.filter(|flags| !flags.is_empty()).map(Value::Flags)
}
