//! Describes, as JSON, the capacity that the pack loses because its cells differ. Each amount of charge is stated as a
//! fraction of the mean cell capacity, in Ah, and in kWh of one string.

use serde::Serialize;

use super::Value;
use crate::cell::CellModel;
use crate::cell_faults::imbalance::{CellSpread, LeftOut, LimitReason, LimitingCell};
use crate::cell_faults::{Imbalance, UnknownImbalance};
use crate::filter::ScalarGaussian;
use crate::io::stamp::format_utc;
use crate::lab::pack_view::energy_kwh;

/// Imbalance of the pack. If the imbalance is unknown, `unknown` states the reason and all other keys are missing.
#[derive(Debug, Serialize)]
pub(super) struct PackPage {
    unknown: Option<String>,
    #[serde(flatten)]
    known: Option<KnownImbalance>,
}

/// Known values; cells count from 1.
#[derive(Debug, Serialize)]
struct KnownImbalance {
    time: String,
    cells: usize,
    mean_capacity_ah: Value,
    usable: Charge,
    lost_by_imbalance: Charge,
    lost_by_weakest: Charge,
    weakest_cell: u16,
    discharge_limit: Limit,
    charge_limit: Limit,
    soc: Spread,
    capacity: Spread,
    resistance: Spread,
    left_out: Vec<Without>,
}

#[derive(Debug, Serialize)]
struct Charge {
    fraction: Value,
    ah: Value,
    kwh: Option<Value>,
}

#[derive(Debug, Serialize)]
struct Limit {
    cell: u16,
    reason: LimitReason,
    by_charge: f64,
    by_capacity: f64,
}

#[derive(Debug, Serialize)]
struct Spread {
    std: f64,
    error: f64,
    lowest_cell: u16,
    lowest: f64,
    highest_cell: u16,
    highest: f64,
}

#[derive(Debug, Serialize)]
struct Without {
    cell: u16,
    reason: LeftOut,
}

impl PackPage {
    pub(super) fn new(imbalance: &Result<Imbalance, UnknownImbalance>, model: Option<&CellModel>) -> Self {
        match imbalance {
            Ok(pack) => Self { unknown: None, known: Some(known(pack, model)) },
            Err(why) => Self { unknown: Some(why.to_string()), known: None },
        }
    }
}

fn known(pack: &Imbalance, model: Option<&CellModel>) -> KnownImbalance {
    let charge = |fraction: ScalarGaussian| Charge {
        fraction: fraction.into(),
        ah: pack.ah(fraction).into(),
        kwh: model.map(|model| energy_kwh(pack, fraction, model).into()),
    };
    KnownImbalance {
        time: format_utc(pack.time),
        cells: pack.cells,
        mean_capacity_ah: pack.mean_ah.into(),
        usable: charge(pack.usable),
        lost_by_imbalance: charge(pack.lost_by_imbalance),
        lost_by_weakest: charge(pack.lost_by_weakest),
        weakest_cell: pack.weakest.0 + 1,
        discharge_limit: limit(&pack.discharge_limit),
        charge_limit: limit(&pack.charge_limit),
        soc: spread(&pack.soc),
        capacity: spread(&pack.capacity),
        resistance: spread(&pack.resistance),
        left_out: pack.left_out.iter().map(|(cell, reason)| Without { cell: cell.0 + 1, reason: *reason }).collect(),
    }
}

fn limit(limit: &LimitingCell) -> Limit {
    let LimitingCell { cell, reason, by_charge, by_capacity } = *limit;
    Limit { cell: cell.0 + 1, reason, by_charge, by_capacity }
}

fn spread(spread: &CellSpread) -> Spread {
    let CellSpread { std, error, lowest, highest } = *spread;
    Spread {
        std,
        error,
        lowest_cell: lowest.0.0 + 1,
        lowest: lowest.1,
        highest_cell: highest.0.0 + 1,
        highest: highest.1,
    }
}
