//! Turns the collected data into a report. The checks look for causes first, so that the report does not list a
//! consequence as a second fault.
//!
//! | file | checks |
//! | --- | --- |
//! | `bus` | interfaces, identifiers, error frames, other nodes that send with the daemon's identifiers, end-to-end protection |
//! | `other_bus` | the message with the pack current on two interfaces |
//! | `unconfigured` | pack voltage and states of charge that are not configured |
//! | `presence` | silent signals, number of cells |
//! | `swapped` | swapped signals |
//! | `values` | units, byte order, limits |
//! | `frozen` | signals that never change, cells that respond differently, cells with the same voltage |
//! | `reported` | the pack's own state of charge against the counted charge and the voltages (`ocv`) |
//! | `electrical` | sign and unit of the current, resistance; without current steps, the sign from the voltage `drift` |
//! | `model` | open-circuit voltage, current offset, noise, the estimator |
//! | `timing` | periods |
//! | `holes` | missing stretches |
//!
//! All checks share the state in `context`. The checks in `values` find unit factors, which `electrical` then applies.

mod bus;
mod context;
mod drift;
mod electrical;
mod frozen;
mod holes;
mod model;
mod ocv;
mod other_bus;
mod presence;
mod reported;
mod swapped;
mod text;
mod timing;
mod unconfigured;
mod unit;
mod values;

use super::observer::WiringObserver;
use super::plan::Kind;
use super::report::{Topic, WiringFinding, WiringReport};
use context::Judge;

impl WiringObserver {
    /// Judges all collected data and returns the report.
    pub fn finish(mut self) -> WiringReport {
        self.end_blocks();
        let mut judge = Judge::new(&self);
        bus::check(&mut judge);
        presence::check(&mut judge);
        other_bus::check(&mut judge);
        swapped::check(&mut judge);
        values::check(&mut judge);
        swapped::check_odd(&mut judge);
        frozen::check_equal(&mut judge);
        values::check_limits(&mut judge);
        frozen::check_stopped(&mut judge);
        reported::check_swapped(&mut judge);
        reported::check_charge(&mut judge);
        reported::check_voltage(&mut judge);
        electrical::check(&mut judge);
        unconfigured::check(&mut judge);
        timing::check(&mut judge);
        holes::check(&mut judge);
        let awake_s = self.awake_s;
        if self.frames > 0 && awake_s < 5.0 {
            let span = text::seconds(awake_s);
            judge.unjudged(format!("only {span} of frames: listen longer so that periods and cells can be judged"));
        }
        fold(&mut judge);
        judge.report
    }
}

/// Folds the consequences of a wrong signal layout (byte order, sign or position of the bits) into the finding on this
/// layout.
fn fold(judge: &mut Judge<'_>) {
    const OF_VALUES: [Topic; 8] = [
        Topic::CellCount,
        Topic::Swapped,
        Topic::Unit,
        Topic::CurrentSign,
        Topic::Frozen,
        Topic::Cell,
        Topic::Range,
        Topic::CellModel,
    ];
    // A wrong temperature layout explains only other temperature findings.
    let explains_all = judge.wrong_layouts.iter().any(|kind| *kind != Kind::Temperature);
    if !judge.wrong_layouts.is_empty() {
        let is_consequence = |finding: &WiringFinding| {
            OF_VALUES.contains(&finding.topic) && (explains_all || finding.title.starts_with("temperature"))
        };
        judge.report.fold(Topic::Layout, is_consequence);
    }
}
