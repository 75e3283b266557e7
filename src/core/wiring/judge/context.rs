//! State that all checks of `doctor` share: the collected data, the plan (what is expected), the unfinished report, and
//! the unit factors that were found.

use std::collections::BTreeSet;

use crate::can::CanId;
use crate::cell::CellModel;
use crate::filter::median;
use crate::quantity::BusIndex;
use crate::wiring::evidence::Series;
use crate::wiring::observer::{BusStats, WiringObserver};
use crate::wiring::plan::{Kind, Plan, SignalPlan};
use crate::wiring::report::{Severity, Topic, WiringFinding, WiringReport};

/// Largest plausible current of a pack, in multiples of the pack's capacity per hour.
pub(super) const MAX_C_RATE: f64 = 30.0;

/// The size of the voltage's slope against the current is judged only if the current explains at least this share of
/// the voltage changes. If the current explains less, the noise of the current makes the slope too small.
pub(super) const EXPLAINED: f64 = 0.8;

/// A configured signal with the statistics of its values.
pub(super) type SignalSeries<'d> = (&'d SignalPlan, &'d Series);

pub(super) struct Judge<'d> {
    pub(super) observed: &'d WiringObserver,
    pub(super) plan: &'d Plan,
    pub(super) report: WiringReport,
    /// Messages whose absence a finding already explains.
    pub(super) explained: BTreeSet<(BusIndex, CanId)>,
    /// Factor that converts the voltages, read as configured, to V.
    pub(super) voltage_factor: f64,
    /// Factor that converts the current, read as configured, to A.
    pub(super) current_factor: f64,
    /// Whether a finding shows that the current or the voltages are read from the wrong signal or with the wrong
    /// layout. If so, the response of the voltages cannot be judged.
    pub(super) is_mixed_up: bool,
    /// Whether the signal for the reported state of charge is known to carry another value.
    pub(super) is_soc_wrong: bool,
    /// Whether a finding shows that the capacity or the scale of the current is wrong. If so, the resistance is not
    /// judged, because it scales with the capacity.
    pub(super) is_size_explained: bool,
    /// Whether the reported state of charge confirms the configured capacity and the sign of the current.
    pub(super) is_capacity_confirmed: bool,
    /// Whether a finding shows that the chemistry or the number of cells is wrong. If so, the voltages cannot be
    /// compared with the cell model.
    pub(super) is_model_wrong: bool,
    /// Kinds of signals whose layout in the DBC is wrong.
    pub(super) wrong_layouts: Vec<Kind>,
}

pub(super) fn error<'j>(judge: &'j mut Judge<'_>, topic: Topic, title: impl Into<String>) -> &'j mut WiringFinding {
    find(judge, Severity::Error, topic, title)
}

pub(super) fn warning<'j>(judge: &'j mut Judge<'_>, topic: Topic, title: impl Into<String>) -> &'j mut WiringFinding {
    find(judge, Severity::Warning, topic, title)
}

pub(super) fn note<'j>(judge: &'j mut Judge<'_>, topic: Topic, title: impl Into<String>) -> &'j mut WiringFinding {
    find(judge, Severity::Note, topic, title)
}

/// Adds a finding; the caller adds the texts.
pub(super) fn find<'j>(
    judge: &'j mut Judge<'_>,
    severity: Severity,
    topic: Topic,
    title: impl Into<String>,
) -> &'j mut WiringFinding {
    judge.report.add(WiringFinding::new(severity, topic, title))
}

impl<'d> Judge<'d> {
    pub(super) fn new(observed: &'d WiringObserver) -> Self {
        let report = WiringReport { seconds: observed.seconds(), frames: observed.frames, ..WiringReport::default() };
        Self {
            observed,
            plan: &observed.plan,
            report,
            explained: BTreeSet::new(),
            voltage_factor: 1.0,
            current_factor: 1.0,
            is_mixed_up: false,
            is_soc_wrong: false,
            is_size_explained: false,
            is_capacity_confirmed: false,
            is_model_wrong: false,
            wrong_layouts: Vec::new(),
        }
    }

    pub(super) fn fine(&mut self, text: String) {
        self.report.fine.push(text);
    }

    pub(super) fn unjudged(&mut self, text: impl Into<String>) {
        self.report.unjudged.push(text.into());
    }

    /// Whether an error or a warning about one of the topics was found.
    pub(super) fn has(&self, topics: &[Topic]) -> bool {
        self.report.findings.iter().any(|f| f.severity != Severity::Note && topics.contains(&f.topic))
    }

    pub(super) fn signals(&self, kind: Kind) -> Vec<SignalSeries<'d>> {
        let all = self.plan.signals.iter().zip(&self.observed.series);
        all.filter(|(signal, _)| Kind::of(signal.binding.channel) == kind).collect()
    }

    pub(super) fn current(&self) -> Option<SignalSeries<'d>> {
        self.signals(Kind::Current).first().copied()
    }

    /// Smallest and largest voltage that the median cell may have (V).
    pub(super) fn voltage_band(&self) -> (f64, f64) {
        // The limits can be close to the voltage limits of the cell, because short peaks do not change a median over
        // time.
        self.plan.pack.model.as_ref().map_or((1.2, 4.6), |m| (m.voltage_min_v - 0.15, m.voltage_max_v + 0.08))
    }

    pub(super) fn pack_ah(&self) -> f64 {
        self.plan.pack.capacity_ah * f64::from(self.plan.pack.strings.max(1))
    }

    /// Number of cells that one voltage reading covers.
    pub(super) fn cells_per_reading(&self) -> f64 {
        if self.plan.pack.is_total { f64::from(self.plan.pack.cells.max(1)) } else { 1.0 }
    }

    /// Voltage of the median cell, read as configured (V). Each cell contributes the median of its readings. `None`
    /// without readings.
    pub(super) fn cell_voltage(&self) -> Option<f64> {
        self.median_of(Kind::Voltage, |series| series.values.median()).map(|v| v / self.cells_per_reading())
    }

    pub(super) fn median_of(&self, kind: Kind, value: impl Fn(&Series) -> Option<f64>) -> Option<f64> {
        median(self.signals(kind).into_iter().filter_map(|(_, series)| value(series)))
    }

    /// Median of the temperature sensors (degrees C); the configured ambient temperature if the median is not
    /// plausible.
    pub(super) fn temperature_c(&self) -> f64 {
        let median = self.median_of(Kind::Temperature, |series| series.values.median());
        median.filter(|c| (-40.0..80.0).contains(c)).unwrap_or(self.plan.pack.ambient_c)
    }

    /// Range of the model's resistance over the SOC and temperatures of the recording (ohm). The range extends from
    /// the lowest immediate resistance to the highest resistance at the time `block_s` after a current step.
    pub(super) fn model_ohm(&self, model: &CellModel, block_s: f64) -> (f64, f64) {
        let spread = |kind, per: f64, middle: f64| {
            let at = |q| self.median_of(kind, |series| series.values.quantile(q)).map_or(middle, |value| value * per);
            [0.1, 0.5, 0.9].map(at)
        };
        let voltages_v = spread(Kind::Voltage, self.voltage_factor / self.cells_per_reading(), f64::NAN);
        let middle_c = self.temperature_c();
        let temperatures_c =
            spread(Kind::Temperature, 1.0, middle_c).map(|c| c.clamp(middle_c - 15.0, middle_c + 15.0));
        let places = voltages_v.into_iter().flat_map(|v| temperatures_c.map(|c| (model.soc_of_ocv(v, c), c)));
        let places = places.map(|(soc, c)| model.grid_position(soc.clamp(0.05, 0.95), c));
        places.fold((f64::INFINITY, 0.0_f64), |(low, high), place| {
            let branch = |i| model.branch_r_ohm(i, &place) * -(-block_s / model.branch_tau_s(i, &place)).exp_m1();
            let r0_ohm = model.r0_ohm(&place);
            let slow_ohm = (0..model.branches.len()).map(branch).sum::<f64>() + r0_ohm;
            (low.min(r0_ohm), high.max(slow_ohm))
        })
    }

    /// The model's resistance with all branches settled, at the recording's median voltage and temperature (ohm).
    pub(super) fn settled_ohm(&self, model: &CellModel) -> f64 {
        let voltage_v = self.cell_voltage().unwrap_or(f64::NAN) * self.voltage_factor;
        let temperature_c = self.temperature_c();
        let soc = model.soc_of_ocv(voltage_v, temperature_c).clamp(0.05, 0.95);
        model.settled_ohm(&model.grid_position(soc, temperature_c))
    }

    pub(super) fn bus(&self, bus: BusIndex) -> Option<&'d BusStats> {
        self.observed.buses.get(bus.index())
    }

    pub(super) fn interface(&self, bus: BusIndex) -> &'d str {
        self.bus(bus).map_or("unknown", |bus| bus.name.as_str())
    }

    /// Another interface on which the identifier was received.
    pub(super) fn other_bus(&self, bus: BusIndex, id: CanId) -> Option<&'d BusStats> {
        let buses = self.observed.buses.iter().enumerate();
        buses.filter(|(index, _)| *index != bus.index()).map(|(_, other)| other).find(|b| b.ids.contains_key(&id))
    }
}
