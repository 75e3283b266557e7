//! Implements the Python class `Monitor`, which processes rows or frames and returns tables.
//!
//! Rows are converted to the frames that would have carried them, with the resolution of the configured signals, as
//! when a CSV file is replayed. The same rows therefore give the same estimates as `packwatch replay`. After Ctrl-C,
//! the inputs that were already processed are kept; their outputs are returned by the next call.

use std::path::{Path, PathBuf};

use packwatch_host::can::decode::{Channel, SensorIndex};
use packwatch_host::can::{CanId, Frame};
use packwatch_host::config::Config;
use packwatch_host::io::plausible;
use packwatch_host::monitor::MonitorConfig;
use packwatch_host::quantity::{BusIndex, CellIndex, Timestamp};
use packwatch_host::replay::{self, MonitorDriver};
use packwatch_host::sample::{Limits, VoltageSource};
use packwatch_lab::single_cell::CellSource;
use pyo3::prelude::*;

use crate::arguments::{cell_source, of_text};
use crate::arrays::{self, Reals, check_rows};
use crate::background_task::{self, BackgroundTask, Progress};
use crate::error::{config as config_error, data};
use crate::exclusive_state::ExclusiveState;
use crate::outputs::{Columns, Outputs, Wanted};
use crate::replay::check_sleep_gap;

const REPORT_EVERY: usize = 16_384;
/// Bit 31 of an identifier marks an extended identifier, as in a DBC and in SocketCAN.
const EXTENDED: u32 = 0x8000_0000;

/// The monitor of a pack.
#[pyclass(frozen, module = "packwatch")]
pub(crate) struct Monitor {
    state: ExclusiveState<State>,
    interfaces: Vec<String>,
    cells: u16,
    is_pack_total: bool,
    limits: PlausibleRanges,
}

struct State {
    driver: MonitorDriver,
    columns: Columns,
    wanted: Wanted,
    cells: usize,
    /// Time of the latest input (s); the next input must not be earlier.
    latest_s: f64,
}

#[pymethods]
impl Monitor {
    /// Creates a monitor without learned values.
    #[new]
    #[pyo3(signature = (config=None, *, text=None, folder=None, cell=None, chemistry=None, rated_ah=None, voltage_min_v=None,
                        voltage_max_v=None, sleep_gap_s=None, estimates_period_s=0.0))]
    #[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
    fn new(
        py: Python<'_>,
        config: Option<PathBuf>,
        text: Option<String>,
        folder: Option<PathBuf>,
        cell: Option<PathBuf>,
        chemistry: Option<String>,
        rated_ah: Option<f64>,
        voltage_min_v: Option<f64>,
        voltage_max_v: Option<f64>,
        sleep_gap_s: Option<f64>,
        estimates_period_s: Option<f64>,
    ) -> PyResult<Self> {
        check_sleep_gap(sleep_gap_s)?;
        let wanted = Wanted::new(estimates_period_s)?;
        let source = cell_source(config, cell, (chemistry, rated_ah, voltage_min_v, voltage_max_v))?;
        let is_cell = source != CellSource::default();
        let config = match &text {
            Some(_) if is_cell => {
                return Err(data("text cannot be given with config, cell or chemistry; give one of them"));
            }
            Some(text) => of_text(text, folder.as_deref().unwrap_or(Path::new("")))?,
            None if folder.is_some() => {
                return Err(data("folder needs text; it is the folder of the files that text names"));
            }
            None if !is_cell => return Err(data("no configuration; give config, text, cell or chemistry")),
            None => py.detach(|| source.load()).map_err(config_error)?,
        };
        Ok(Self::of(&config, sleep_gap_s, wanted))
    }

    /// Number of cells in series.
    #[getter]
    fn cells(&self) -> u16 {
        self.cells
    }

    /// Names of the interfaces by number.
    #[getter]
    fn interfaces(&self) -> Vec<String> {
        self.interfaces.clone()
    }

    /// Number of values that no frame of the configuration can carry, in all rows processed so far.
    #[getter]
    fn uncarried_values(&self, py: Python<'_>) -> PyResult<usize> {
        Ok(self.state.wait(py)?.driver.uncarried_values)
    }

    /// Processes rows. The times are seconds or `datetime64`, and do not run backwards.
    #[pyo3(signature = (time_s, current_a, voltage_v, temperature_c=None, *, progress=false))]
    fn rows(
        &self,
        py: Python<'_>,
        time_s: &Bound<'_, PyAny>,
        current_a: &Bound<'_, PyAny>,
        voltage_v: &Bound<'_, PyAny>,
        temperature_c: Option<&Bound<'_, PyAny>>,
        progress: bool,
    ) -> PyResult<Outputs> {
        let time_s = times(time_s)?;
        let input = RowInput {
            current_a: arrays::column("current_a", current_a)?,
            voltage_v: arrays::reals("voltage_v", voltage_v)?,
            temperature_c: temperature_c.map(|values| arrays::reals("temperature_c", values)).transpose()?,
            is_pack_total: self.is_pack_total,
        };
        input.check(time_s.rows, if self.is_pack_total { 1 } else { usize::from(self.cells) })?;
        self.limits.check(&input)?;
        self.limits.check_time(&time_s, &input)?;
        self.work(py, progress, &time_s, |state, work| state.take_rows(&time_s, &input, work))
    }

    /// Processes frames.
    #[pyo3(signature = (time_s, can_id, data, *, length=None, interface=None, progress=false))]
    #[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
    fn frames(
        &self,
        py: Python<'_>,
        time_s: &Bound<'_, PyAny>,
        can_id: &Bound<'_, PyAny>,
        data: &Bound<'_, PyAny>,
        length: Option<&Bound<'_, PyAny>>,
        interface: Option<&str>,
        progress: bool,
    ) -> PyResult<Outputs> {
        let time_s = times(time_s)?;
        let can_id = arrays::words("can_id", can_id)?;
        let payloads = arrays::bytes("data", data)?;
        let length = length.map(|values| arrays::words("length", values)).transpose()?;
        check_rows("can_id", can_id.rows, "time_s", time_s.rows)?;
        check_rows("data", payloads.rows, "time_s", time_s.rows)?;
        length.iter().try_for_each(|length| check_rows("length", length.rows, "time_s", time_s.rows))?;
        let bus = self.bus(interface)?;
        let frame = |row: usize| {
            let length = length.as_ref().map_or(payloads.columns, |length| length.values[row] as usize);
            frame(row, can_id.values[row], payloads.row(row), length)
        };
        // All frames are checked before the first frame is processed, so that an error does not leave some of them
        // processed.
        let frames = (0..time_s.rows).map(frame).collect::<PyResult<Vec<Frame>>>()?;
        self.work(py, progress, &time_s, |state, work| {
            for (row, frame) in frames.iter().enumerate() {
                let time = state.begin(time_s.values[row]);
                state.driver.handle_frame(time, bus, frame);
                state.columns.take(state.wanted, &mut state.driver.out);
                report(row, work);
            }
        })
    }

    /// Continues at `time_s`, after a gap of unknown length.
    fn gap(&self, py: Python<'_>, time_s: f64) -> PyResult<Outputs> {
        check_time("time_s", time_s)?;
        let mut state = self.state.wait(py)?;
        state.latest_s = time_s;
        state.driver.handle_unknown_gap(Timestamp::from_secs(time_s));
        state.finish(py, &self.interfaces)
    }

    /// Ends the input, so that the last samples become estimates.
    fn finish(&self, py: Python<'_>) -> PyResult<Outputs> {
        let mut state = self.state.wait(py)?;
        state.driver.finish();
        state.finish(py, &self.interfaces)
    }
}

impl Monitor {
    fn of(config: &Config, sleep_gap_s: Option<f64>, wanted: Wanted) -> Self {
        let sample = &config.monitor.sample;
        let sleep_gap_s = sleep_gap_s.unwrap_or_else(|| replay::sleep_gap_s(&config.monitor));
        let driver = MonitorDriver::new(config.monitor.clone(), sleep_gap_s);
        Self {
            interfaces: config.interface_names(),
            cells: sample.cells,
            is_pack_total: matches!(sample.voltage_source, VoltageSource::PackTotal { .. }),
            limits: PlausibleRanges::new(&config.monitor),
            state: ExclusiveState::new(State {
                driver,
                columns: Columns::default(),
                wanted,
                cells: sample.cells.into(),
                latest_s: f64::NEG_INFINITY,
            }),
        }
    }

    fn bus(&self, interface: Option<&str>) -> PyResult<BusIndex> {
        let name = interface.or(self.interfaces.first().map(String::as_str)).unwrap_or_default();
        let found = self.interfaces.iter().position(|known| known == name).and_then(|index| u8::try_from(index).ok());
        let allowed = self.interfaces.join(", ");
        found.map(BusIndex).ok_or_else(|| data(format!("interface {name:?}, must be one of {allowed}")))
    }

    /// Processes rows or frames with `take` and returns the tables.
    fn work(
        &self,
        py: Python<'_>,
        is_shown: bool,
        time_s: &Reals,
        take: impl FnOnce(&mut State, &BackgroundTask) + Send,
    ) -> PyResult<Outputs> {
        let progress = Progress { is_shown, total: Some(time_s.rows as u64), unit: "row" };
        let mut turn = self.state.wait(py)?;
        let state: &mut State = &mut turn;
        check_order(state.latest_s, &time_s.values)?;
        background_task::run(py, progress, |work| take(state, work))?;
        turn.finish(py, &self.interfaces)
    }
}

impl State {
    fn take_rows(&mut self, time_s: &Reals, input: &RowInput, work: &BackgroundTask) {
        let mut values = input.channels();
        for row in 0..time_s.rows {
            input.fill(row, &mut values);
            let time = self.begin(time_s.values[row]);
            self.driver.handle_row(time, &values);
            self.columns.take(self.wanted, &mut self.driver.out);
            report(row, work);
        }
    }

    /// Begins an input at `time_s`. If its estimates would not become rows, they are not computed.
    fn begin(&mut self, time_s: f64) -> Timestamp {
        let time = Timestamp::from_secs(time_s);
        self.latest_s = time_s;
        self.driver.out.want_estimates = self.columns.wants_estimates(self.wanted, time, self.cells);
        time
    }

    fn finish(&mut self, py: Python<'_>, interfaces: &[String]) -> PyResult<Outputs> {
        self.columns.take(self.wanted, &mut self.driver.out);
        self.columns.finish(py, interfaces)
    }
}

/// Rows of readings.
struct RowInput {
    current_a: Reals,
    voltage_v: Reals,
    temperature_c: Option<Reals>,
    is_pack_total: bool,
}

impl RowInput {
    fn check(&self, rows: usize, voltages: usize) -> PyResult<()> {
        check_rows("current_a", self.current_a.rows, "time_s", rows)?;
        check_rows("voltage_v", self.voltage_v.rows, "time_s", rows)?;
        self.temperature_c.iter().try_for_each(|of| check_rows("temperature_c", of.rows, "time_s", rows))?;
        let found = self.voltage_v.columns;
        if found != voltages {
            return Err(data(format!("voltage_v has {found} columns, must have {voltages} as in the configuration")));
        }
        let most = usize::from(u16::MAX);
        let sensors = self.temperature_c.as_ref().map_or(0, |of| of.columns);
        if sensors > most {
            return Err(data(format!("temperature_c has {sensors} columns, must have at most {most}")));
        }
        Ok(())
    }

    /// Channels of a row, without values.
    fn channels(&self) -> Vec<(Channel, Option<f64>)> {
        let numbers = |count: usize| 0..u16::try_from(count).unwrap_or(u16::MAX);
        let cells = numbers(self.voltage_v.columns).map(|cell| Channel::CellVoltage(CellIndex(cell)));
        let sensors = numbers(self.temperature_c.as_ref().map_or(0, |of| of.columns));
        let mut channels = vec![Channel::Current];
        if self.is_pack_total {
            channels.push(Channel::PackVoltage);
        } else {
            channels.extend(cells);
        }
        channels.extend(sensors.map(|sensor| Channel::Temperature(SensorIndex(sensor))));
        channels.into_iter().map(|channel| (channel, None)).collect()
    }

    /// Writes the values of a row to its channels.
    fn fill(&self, row: usize, values: &mut [(Channel, Option<f64>)]) {
        let temperatures = self.temperature_c.as_ref().map_or(&[][..], |of| of.row(row));
        let all = self.current_a.row(row).iter().chain(self.voltage_v.row(row)).chain(temperatures);
        values.iter_mut().zip(all).for_each(|(value, found)| value.1 = Some(*found));
    }
}

fn report(row: usize, work: &BackgroundTask) {
    if (row + 1).is_multiple_of(REPORT_EVERY) {
        work.advance(REPORT_EVERY as u64);
    }
}

/// A larger time (s) is probably not in seconds. This time is in the year 2261, near the largest time in nanoseconds.
const MAX_TIME_S: f64 = 9.2e9;

/// Converts times to seconds. `datetime64` becomes Unix time.
fn times(time_s: &Bound<'_, PyAny>) -> PyResult<Reals> {
    let time_s = arrays::seconds("time_s", time_s)?;
    for (row, time_s) in time_s.values.iter().enumerate() {
        check_time(format_args!("time_s[{row}]"), *time_s)?;
    }
    Ok(time_s)
}

/// Checks that a time is a finite number of seconds. A Unix time in another unit gives an error that names the unit.
fn check_time(name: impl std::fmt::Display, time_s: f64) -> PyResult<()> {
    if time_s.abs() <= MAX_TIME_S {
        return Ok(());
    }
    // Unix times from 1973 to 5138; the ranges of the three units do not overlap.
    let units =
        [(1e11, 1e14, "milliseconds", "1e3"), (1e14, 1e17, "microseconds", "1e6"), (1e17, 1e20, "nanoseconds", "1e9")];
    let unit = units.iter().find(|(low, high, ..)| (*low..*high).contains(&time_s));
    let hint = unit.map_or(String::new(), |(.., unit, divisor)| format!(": probably {unit}, divide by {divisor}"));
    let allowed = if time_s.is_finite() { "seconds, at most 9.2e9" } else { "a finite number" };
    Err(data(format!("{name} = {time_s}, must be {allowed}{hint}")))
}

/// Checks that the times do not run backwards.
fn check_order(latest_s: f64, times_s: &[f64]) -> PyResult<()> {
    let mut before = latest_s;
    for (row, &time_s) in times_s.iter().enumerate() {
        if time_s < before {
            let of =
                if row == 0 { "the latest time of the call before".to_owned() } else { format!("time_s[{}]", row - 1) };
            return Err(data(format!("time_s[{row}] = {time_s}, must not be before {of} = {before}")));
        }
        before = time_s;
    }
    Ok(())
}

/// Configured ranges of plausible readings: smallest and largest value.
#[derive(Debug, Clone, Copy)]
struct PlausibleRanges {
    current_a: (f64, f64),
    voltage_v: (f64, f64),
    temperature_c: (f64, f64),
    capacity_ah: f64,
}

impl PlausibleRanges {
    fn new(config: &MonitorConfig) -> Self {
        let sample = &config.sample;
        let range = |limits: &Limits| (limits.min, limits.max);
        let (low, high) = range(&sample.voltage);
        let cells = match sample.voltage_source {
            VoltageSource::PackTotal { series } => f64::from(series),
            VoltageSource::Cells => 1.0,
        };
        let voltage_v = (low * cells, high * cells);
        let capacity_ah = config.model.rated_capacity_ah * f64::from(sample.strings);
        Self { current_a: range(&sample.current), voltage_v, temperature_c: range(&sample.temperature), capacity_ah }
    }

    /// Checks that the charge moved by the current is possible. If it is not, the times are probably not in seconds.
    fn check_time(&self, time_s: &Reals, input: &RowInput) -> PyResult<()> {
        const MOST_ROWS: usize = 50_000;
        let rows = time_s.rows.min(MOST_ROWS);
        plausible::check_charge(&time_s.values[..rows], &input.current_a.values[..rows], self.capacity_ah).map_err(
            |of| {
                let probably = of.probable.map_or_else(String::new, |unit| format!(", probably {unit}"));
                data(format!("time_s must be seconds{probably}: {}", of.what))
            },
        )
    }

    /// Checks that the values are not in another unit.
    fn check(&self, input: &RowInput) -> PyResult<()> {
        check_unit("current_a", &input.current_a, self.current_a, &OtherUnit::MILLIAMPERE)?;
        check_unit("voltage_v", &input.voltage_v, self.voltage_v, &OtherUnit::MILLIVOLT)?;
        let kelvin = |of: &Reals| check_unit("temperature_c", of, self.temperature_c, &OtherUnit::KELVIN);
        input.temperature_c.as_ref().map_or(Ok(()), kelvin)
    }
}

/// A unit that readings may have by mistake.
struct OtherUnit {
    /// The expected unit.
    expected: &'static str,
    /// The other unit, and how to convert it.
    remedy: &'static str,
    converted: fn(f64) -> f64,
}

impl OtherUnit {
    const MILLIAMPERE: Self = Self { expected: "A", remedy: "mA: divide by 1000", converted: |value| value / 1000.0 };
    const MILLIVOLT: Self = Self { expected: "V", remedy: "mV: divide by 1000", converted: |value| value / 1000.0 };
    const KELVIN: Self =
        Self { expected: "degrees C", remedy: "K: subtract 273.15", converted: |value| value - 273.15 };
}

/// Returns an error if most values are plausible only in another unit.
fn check_unit(name: &str, found: &Reals, (low, high): (f64, f64), other: &OtherUnit) -> PyResult<()> {
    let is_plausible = |value: f64| (low..=high).contains(&value);
    let is_other = |value: &f64| !is_plausible(*value) && is_plausible((other.converted)(*value));
    let known = found.values.iter().filter(|value| value.is_finite()).count();
    if 2 * found.values.iter().filter(|value| is_other(value)).count() <= known {
        return Ok(());
    }
    let first = found.values.iter().position(is_other).unwrap_or_default();
    let (place, value) = (found.index(first), found.values[first]);
    Err(data(format!("{name}{place} = {value}, must be {low} to {high} {}: probably {}", other.expected, other.remedy)))
}

fn frame(row: usize, id: u32, payload: &[u8], length: usize) -> PyResult<Frame> {
    let can_id = if id & EXTENDED == 0 { CanId::standard(id) } else { CanId::extended(id & !EXTENDED) };
    let allowed = "must be at most 0x7FF, or with bit 31 set for an extended identifier at most 0x1FFFFFFF";
    let can_id = can_id.ok_or_else(|| data(format!("can_id[{row}] = {id:#X}, {allowed}")))?;
    let payload = payload.get(..length).ok_or_else(|| {
        data(format!("length[{row}] = {length}, must be at most {}, the number of columns of data", payload.len()))
    })?;
    let frame = if length <= 8 { Frame::classic(can_id, payload) } else { Frame::fd(can_id, false, false, payload) };
    frame.ok_or_else(|| {
        data(format!("length[{row}] = {length}, must be a length of CAN FD: 12, 16, 20, 24, 32, 48 or 64"))
    })
}
