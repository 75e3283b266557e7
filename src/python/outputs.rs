//! Collects the outputs of a monitor in columns.

use std::sync::Arc;

use arrow_array::builder::BinaryBuilder;
use arrow_array::{ArrayRef, BooleanArray, Float64Array, StringArray, UInt16Array, UInt32Array};
use packwatch_host::monitor::{Estimate, Event, Outputs as CoreOutputs, Transmit};
use packwatch_host::quantity::Timestamp;
use packwatch_host::replay::ESTIMATE_COLUMNS;
use pyo3::prelude::*;

use crate::error::data;
use crate::table::{Table, reals};

/// Number of columns of an estimate that contain reals: all columns except time, cell and acceptance.
const REALS: usize = ESTIMATE_COLUMNS.len() - 3;

/// Tables of the outputs.
#[pyclass(frozen, module = "packwatch")]
pub(crate) struct Outputs {
    /// Estimates, with the columns of `replay --estimates`.
    #[pyo3(get)]
    estimates: Py<Table>,
    /// Events: time, name, and the document as in `replay --events`.
    #[pyo3(get)]
    events: Py<Table>,
    /// The frames that would be sent.
    #[pyo3(get)]
    frames: Py<Table>,
}

#[pymethods]
impl Outputs {
    fn __repr__(&self) -> String {
        let [estimates, events, frames] = [&self.estimates, &self.events, &self.frames].map(|table| table.get().rows());
        format!("<packwatch.Outputs: {estimates} estimates, {events} events, {frames} frames>")
    }
}

/// Columns to which outputs are appended.
#[derive(Default)]
pub(crate) struct Columns {
    estimates: EstimateColumns,
    events: Vec<Event>,
    frames: Vec<Transmit>,
}

/// The outputs that the caller wants.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wanted {
    /// Length of the periods, ns. Each cell has at most one estimate in each period. 0 = all estimates, `None` = no
    /// estimates.
    pub(crate) period_ns: Option<i64>,
}

impl Wanted {
    /// Creates a selection from a period in seconds.
    pub(crate) fn new(period_s: Option<f64>) -> PyResult<Self> {
        let allowed = |period_s: f64| (0.0..=1e9).contains(&period_s);
        match period_s {
            Some(period_s) if !allowed(period_s) => {
                Err(data(format!("estimates_period_s = {period_s}, must be 0 to 1e9, or None")))
            }
            period_s => Ok(Self { period_ns: period_s.map(|period_s| (period_s * 1e9) as i64) }),
        }
    }
}

impl Columns {
    pub(crate) fn take(&mut self, wanted: Wanted, out: &mut CoreOutputs) {
        self.add(wanted, out);
        out.clear();
    }

    pub(crate) fn add(&mut self, wanted: Wanted, out: &CoreOutputs) {
        if let Some(period_ns) = wanted.period_ns {
            out.estimates.iter().for_each(|estimate| self.estimates.add(period_ns, estimate));
        }
        self.events.extend_from_slice(&out.events);
        self.frames.extend_from_slice(&out.frames);
    }

    /// Whether an estimate at `time` may become a row. It cannot if each of the pack's `cells` cells already has a row
    /// in the present period.
    pub(crate) fn wants_estimates(&self, wanted: Wanted, time: Timestamp, cells: usize) -> bool {
        match wanted.period_ns {
            None => false,
            Some(0) => true,
            Some(period_ns) => self.estimates.wants(period_ns, time, cells),
        }
    }

    /// Returns the tables and clears the columns. `interfaces` are the names of the interfaces in the order of their
    /// numbers.
    pub(crate) fn finish(&mut self, py: Python<'_>, interfaces: &[String]) -> PyResult<Outputs> {
        Ok(Outputs {
            estimates: self.estimates.finish()?.into_py(py)?,
            events: events(&std::mem::take(&mut self.events))?.into_py(py)?,
            frames: frames(&std::mem::take(&mut self.frames), interfaces)?.into_py(py)?,
        })
    }
}

#[derive(Default)]
struct EstimateColumns {
    time_s: Vec<f64>,
    cell: Vec<u16>,
    reals: [Vec<f64>; REALS],
    accepted: Vec<bool>,
    /// Time of the first estimate.
    first: Option<Timestamp>,
    /// Period of the latest row of each cell.
    periods: Vec<Option<i64>>,
    /// The latest period, and the number of cells that have a row in this period.
    latest: Option<(i64, usize)>,
}

impl EstimateColumns {
    #[inline]
    fn add(&mut self, period_ns: i64, estimate: &Estimate) {
        if period_ns > 0 && !self.begins_period(period_ns, estimate) {
            return;
        }
        let e = estimate;
        let [u1_v, u2_v, u3_v] = e.branch_v;
        let values: [f64; REALS] = [
            e.soc,
            e.soc_std,
            u1_v,
            u2_v,
            u3_v,
            e.capacity_ah,
            e.capacity_std_ah,
            e.resistance_ratio,
            e.resistance_ratio_std,
            e.innovation_v,
            e.innovation_std_v,
            e.measured.voltage_v,
            e.measured.current_a,
            e.measured.temperature_c,
        ];
        self.time_s.push(seconds(e.time));
        self.cell.push(e.cell.0);
        self.accepted.push(e.accepted);
        self.reals.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
    }

    /// Whether this is the first estimate of its cell in its period. Periods are counted from the first estimate. If
    /// the clock goes back, an earlier period begins again.
    fn begins_period(&mut self, period_ns: i64, estimate: &Estimate) -> bool {
        let first = *self.first.get_or_insert(estimate.time);
        let period = estimate.time.nanos().saturating_sub(first.nanos()).div_euclid(period_ns);
        let cell = estimate.cell.index();
        if self.periods.len() <= cell {
            self.periods.resize(cell + 1, None);
        }
        let begins = self.periods[cell].is_none_or(|last| period != last);
        if begins {
            self.periods[cell] = Some(period);
            let (latest, cells) = self.latest.unwrap_or((period, 0));
            self.latest = if period == latest { Some((latest, cells + 1)) } else { Some((period, 1)) };
        }
        begins
    }

    fn wants(&self, period_ns: i64, time: Timestamp, cells: usize) -> bool {
        let (Some(first), Some((latest, done))) = (self.first, self.latest) else { return true };
        done < cells || time.nanos().saturating_sub(first.nanos()).div_euclid(period_ns) != latest
    }

    fn finish(&mut self) -> PyResult<Table> {
        let time_s: ArrayRef = Arc::new(Float64Array::from(std::mem::take(&mut self.time_s)));
        let cell: ArrayRef = Arc::new(UInt16Array::from(std::mem::take(&mut self.cell)));
        let accepted: ArrayRef = Arc::new(BooleanArray::from(std::mem::take(&mut self.accepted)));
        let mut arrays = vec![time_s, cell];
        arrays.extend(self.reals.iter_mut().map(|column| reals(std::mem::take(column))));
        arrays.insert(13, accepted);
        Table::new(ESTIMATE_COLUMNS.into_iter().zip(arrays).collect())
    }
}

fn seconds(time: Timestamp) -> f64 {
    time.nanos() as f64 / 1e9
}

fn times(times: impl Iterator<Item = Timestamp>) -> ArrayRef {
    Arc::new(times.map(seconds).collect::<Float64Array>())
}

fn events(events: &[Event]) -> PyResult<Table> {
    let documents: Result<Vec<String>, _> = events.iter().map(serde_json::to_string).collect();
    let documents = documents.map_err(data)?;
    let name = |event: &Event| match serde_json::to_value(event.kind) {
        Ok(fields) => fields["event"].as_str().map(str::to_owned),
        Err(_) => None,
    };
    Table::new(vec![
        ("time_s", times(events.iter().map(|event| event.time))),
        ("event", Arc::new(events.iter().map(name).collect::<StringArray>()) as ArrayRef),
        ("document", Arc::new(StringArray::from(documents)) as ArrayRef),
    ])
}

fn frames(frames: &[Transmit], interfaces: &[String]) -> PyResult<Table> {
    let interface = |sent: &Transmit| interfaces.get(sent.bus.index()).map(String::as_str);
    let mut payloads = BinaryBuilder::new();
    frames.iter().for_each(|sent| payloads.append_value(sent.frame.data()));
    Table::new(vec![
        ("time_s", times(frames.iter().map(|sent| sent.time))),
        ("interface", Arc::new(frames.iter().map(interface).collect::<StringArray>()) as ArrayRef),
        (
            "can_id",
            Arc::new(UInt32Array::from_iter_values(frames.iter().map(|sent| sent.frame.id().dbc_number()))) as ArrayRef,
        ),
        ("data", Arc::new(payloads.finish()) as ArrayRef),
    ])
}
