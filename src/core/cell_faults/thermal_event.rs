//! Detects a thermal event: the voltage of a cell collapses, or a temperature rises faster than the current explains.
//!
//! In: readings of cell voltages (V) and temperatures (degrees C) before the plausibility checks, because a thermal
//! runaway changes them faster than plausible. Out: for each cell, whether there is evidence of a thermal event.
//!
//! * **Collapse**: the voltage has fallen by [`FALL`] within a minute, and by [`FALL`] more than the median of the other
//!   cells. At least [`LEAST_READINGS`] different readings in [`LEAST_S`] show the fall. A cell that may be almost empty
//!   is not judged, because its voltage can fall as fast. A broken sense wire raises the voltage of a neighbour, and a
//!   dead channel repeats one value; neither counts.
//! * **Heating**: a temperature rises by [`RATE_C_PER_S`] for [`LEAST_S`], or by [`AHEAD_C`] more than the median of the
//!   other sensors within [`WINDOW_S`]. The heat that the current can explain is deducted. A cell of the sensor is
//!   named: the cell whose voltage has fallen most.
//!
//! The limits of voltage, rate and duration are those by which GB 38031 (appendix C) confirms a thermal runaway.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::filter::{median, square};
use crate::quantity::{CellIndex, InvalidState, SensorIndex, Timestamp};

/// Smallest fall of a voltage, as a fraction of the voltage before (GB 38031, appendix C).
const FALL: f64 = 0.25;
/// Smallest rate of a temperature without a comparison (degrees C/s; GB 38031, appendix C).
const RATE_C_PER_S: f64 = 1.0;
/// Shortest duration of a fall or rise (s; GB 38031, appendix C).
const LEAST_S: f64 = 3.0;
/// Least number of readings that show a fall, and of rises of a temperature. A single disturbance gives fewer.
const LEAST_READINGS: u32 = 3;
/// Lead of a temperature over the median of the other sensors (degrees C).
const AHEAD_C: f64 = 10.0;
/// Longest time over which a rise is judged (s).
const WINDOW_S: f64 = 120.0;
/// Rise of a temperature sensor that a current of 1 C explains: the part of the first seconds (degrees C/s), the whole,
/// and the part in which the sensors of a pack differ (degrees C). Cells and busbars heat with the square of the current.
const EXPLAINED_C_PER_S: f64 = 0.1;
const EXPLAINED_C: f64 = 5.0;
const EXPLAINED_DIFFERENCE_C: f64 = 1.0;
/// Time over which the square of the current is averaged (s). A busbar cools in about a minute.
const HEAT_S: f64 = 60.0;
/// Current that counts while the current is unknown (1/h).
const UNKNOWN_RATE_PER_H: f64 = 1.0;
/// Time between two references of a voltage, and between two refreshes of the values (s).
const REFRESH_S: f64 = 30.0;
/// Evidence lasts this long after the last reading that shows it (s).
const HOLD_S: f64 = 60.0;
/// A cell whose SOC may be below this is not judged by its voltage.
const ALMOST_EMPTY: f64 = 0.1;
/// Shortest distance of the readings that a trail stores (s), and their number.
const FAST: (f64, usize) = (0.5, 8);
const SLOW: (f64, usize) = (10.0, 13);

/// Watches the cells of a pack for a thermal event.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThermalWatch {
    cells: Vec<CellState>,
    sensors: Vec<SensorState>,
    refreshed: Option<Timestamp>,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CellState {
    latest_v: Option<f64>,
    /// Whether a voltage has arrived since the last refresh.
    is_fresh: bool,
    /// Voltages at the last two refreshes.
    references_v: [Option<f64>; 2],
    /// Whether the cell may have been almost empty at the last refresh.
    may_be_empty: bool,
    fall: Option<Fall>,
    /// Until when there is evidence.
    collapsed_until: Option<Timestamp>,
    heating_until: Option<Timestamp>,
}

/// A voltage that is far below its reference.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Fall {
    since: Timestamp,
    first_v: f64,
    readings: u32,
    /// Whether the readings differ. A dead channel repeats one value.
    has_moved: bool,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SensorState {
    fast: Trail,
    slow: Trail,
    /// Mean square of the current (1/h^2).
    heat: f64,
}

/// Recent readings of a sensor.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
struct Trail(VecDeque<(Timestamp, f64)>);

impl Trail {
    /// Adds a reading if it is far enough from the last one, and drops what is too old.
    fn add(&mut self, now: Timestamp, value: f64, (spacing_s, length): (f64, usize)) {
        while self.0.front().is_some_and(|(time, _)| !(0.0..=WINDOW_S).contains(&now.since(*time))) {
            self.0.pop_front();
        }
        if self.0.back().is_none_or(|(time, _)| now.since(*time) >= spacing_s) {
            if self.0.len() == length {
                self.0.pop_front();
            }
            self.0.push_back((now, value));
        }
    }

    /// Age (s) of each reading since which the temperature has only risen, in at least [`LEAST_READINGS`] steps up to
    /// `value`, and the rise since then (degrees C). The largest step does not count, because it may be a disturbance.
    fn rises(&self, now: Timestamp, value: f64) -> impl Iterator<Item = (f64, f64)> + '_ {
        let (mut next, mut steps, mut largest) = (value, 0, 0.0_f64);
        self.0
            .iter()
            .rev()
            .map_while(move |&(time, earlier)| {
                steps += u32::from(earlier < next);
                largest = largest.max(next - earlier);
                let has_fallen = std::mem::replace(&mut next, earlier) < earlier;
                (!has_fallen).then(|| (steps >= LEAST_READINGS).then(|| (now.since(time), value - earlier - largest)))
            })
            .flatten()
    }

    /// The reading at `time`, or the next reading after it.
    fn at(&self, time: Timestamp) -> Option<f64> {
        self.0.iter().find(|(at, _)| *at >= time).map(|(_, value)| *value)
    }
}

/// Heat that the current explains in a sensor.
#[derive(Debug, Clone, Copy)]
struct Heat {
    /// Mean square of the current (1/h^2).
    square_per_h2: f64,
}

impl Heat {
    /// Rise that the current explains in a time (degrees C).
    fn explained_c(self, age_s: f64) -> f64 {
        self.square_per_h2 * (EXPLAINED_C_PER_S * age_s).min(EXPLAINED_C)
    }

    /// Difference between the rises of two sensors that the current explains (degrees C).
    fn explained_difference_c(self) -> f64 {
        self.square_per_h2 * EXPLAINED_DIFFERENCE_C
    }
}

impl ThermalWatch {
    /// Creates a watch without readings.
    pub fn new(cells: usize, sensors: usize) -> Self {
        let trail = |(_, length): (f64, usize)| Trail(VecDeque::with_capacity(length));
        let sensor = || SensorState { fast: trail(FAST), slow: trail(SLOW), heat: 0.0 };
        let sensors = (0..sensors).map(|_| sensor()).collect();
        Self { cells: vec![CellState::default(); cells], sensors, refreshed: None }
    }

    /// Forgets the readings, because no reading follows for a while. Evidence ends.
    pub fn interrupt(&mut self) {
        *self = Self::new(self.cells.len(), self.sensors.len());
    }

    /// Whether the watch has as many cells and sensors as another watch.
    pub fn fits(&self, other: &Self) -> bool {
        (self.cells.len(), self.sensors.len()) == (other.cells.len(), other.sensors.len())
    }

    /// Checks the numbers of a stored state.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        let voltages =
            self.cells.iter().flat_map(|cell| cell.references_v.into_iter().chain([cell.latest_v])).flatten();
        let trails = self.sensors.iter().flat_map(|sensor| sensor.fast.0.iter().chain(&sensor.slow.0));
        let temperatures = trails.map(|(_, value)| *value).chain(self.sensors.iter().map(|sensor| sensor.heat));
        InvalidState::unless_numbers("a reading of the thermal watch", voltages.chain(temperatures))
    }

    /// Handles a reading of a cell's voltage (V). Returns whether the evidence for this cell has changed.
    #[inline]
    pub fn handle_voltage(&mut self, now: Timestamp, cell: CellIndex, voltage_v: f64) -> bool {
        let Some(state) = self.cells.get_mut(cell.index()).filter(|_| voltage_v.is_finite()) else { return false };
        (state.latest_v, state.is_fresh) = (Some(voltage_v), true);
        if state.share_left().is_none_or(|share| share >= 1.0 - FALL) {
            state.fall = None;
            return false;
        }
        self.handle_fallen(now, cell.index(), voltage_v)
    }

    /// Handles a voltage that is far below its reference.
    #[cold]
    fn handle_fallen(&mut self, now: Timestamp, cell: usize, voltage_v: f64) -> bool {
        let first = Fall { since: now, first_v: voltage_v, readings: 0, has_moved: false };
        let state = &mut self.cells[cell];
        let fall = state.fall.get_or_insert(first);
        fall.readings = fall.readings.saturating_add(1);
        fall.has_moved |= voltage_v != fall.first_v;
        let is_shown = now.since(fall.since) >= LEAST_S && fall.readings >= LEAST_READINGS && fall.has_moved;
        if !is_shown || state.may_be_empty || !self.is_alone(cell) {
            return false;
        }
        let state = &mut self.cells[cell];
        let is_new = !is_current(state.collapsed_until, now);
        state.collapsed_until = Some(now.plus_secs(HOLD_S));
        is_new
    }

    /// Whether the voltage of a cell has fallen much more than the voltages of the others, without a rise of a
    /// neighbour's voltage.
    fn is_alone(&self, cell: usize) -> bool {
        let others = self.cells.iter().enumerate().filter(|(index, _)| *index != cell);
        let shares: Vec<f64> = others.filter_map(|(_, other)| other.share_left()).collect();
        let (Some(own), Some(middle)) = (self.cells[cell].share_left(), median(shares.iter().copied())) else {
            return false;
        };
        let neighbours = [cell.checked_sub(1), Some(cell + 1)].into_iter().flatten();
        let rise = neighbours.filter_map(|index| self.cells.get(index)?.rise()).fold(0.0, f64::max);
        shares.len() > 1 && middle - own >= FALL && rise < 0.5 * (1.0 - own)
    }

    /// Handles a reading of a temperature sensor (degrees C). `rate_per_h`: current relative to
    /// the rated capacity; `None` = unknown. `measures`: whether the sensor measures a cell. Returns the cell if its evidence has changed.
    pub fn handle_temperature(
        &mut self,
        now: Timestamp,
        sensor: SensorIndex,
        temperature_c: f64,
        rate_per_h: Option<f64>,
        measures: impl Fn(usize) -> bool,
    ) -> Option<CellIndex> {
        let state = self.sensors.get_mut(sensor.index()).filter(|_| temperature_c.is_finite())?;
        let present = square(rate_per_h.unwrap_or(UNKNOWN_RATE_PER_H));
        let elapsed_s = state.fast.0.back().map_or(0.0, |(time, _)| now.since(*time)).max(0.0);
        state.heat += (present - state.heat) * (1.0 - libm::exp(-elapsed_s / HEAT_S));
        let heat = Heat { square_per_h2: state.heat.max(present) };
        let is_rising = self.is_rising(now, sensor.index(), temperature_c, heat);
        let state = &mut self.sensors[sensor.index()];
        state.fast.add(now, temperature_c, FAST);
        state.slow.add(now, temperature_c, SLOW);
        if !is_rising {
            return None;
        }
        let of_sensor = || (0..self.cells.len()).filter(|&cell| measures(cell));
        let named = of_sensor().find(|&cell| is_current(self.cells[cell].heating_until, now));
        let share = |cell: usize| self.cells[cell].share_left().unwrap_or(1.0);
        let cell = named.or_else(|| of_sensor().min_by(|&a, &b| share(a).total_cmp(&share(b))))?;
        self.cells[cell].heating_until = Some(now.plus_secs(HOLD_S));
        named.is_none().then(|| CellIndex(u16::try_from(cell).unwrap_or(u16::MAX)))
    }

    /// Whether a temperature rises faster than the current and the other sensors explain.
    fn is_rising(&self, now: Timestamp, sensor: usize, temperature_c: f64, heat: Heat) -> bool {
        let state = &self.sensors[sensor];
        let is_fast =
            |(age_s, rise_c): (f64, f64)| age_s >= LEAST_S && rise_c - heat.explained_c(age_s) >= RATE_C_PER_S * age_s;
        let is_ahead = |(age_s, rise_c): (f64, f64)| {
            let least_c = AHEAD_C + heat.explained_difference_c();
            rise_c >= least_c && self.rise_of_others(now, sensor, age_s).is_some_and(|rise| rise_c - rise >= least_c)
        };
        state.fast.rises(now, temperature_c).any(is_fast) || state.slow.rises(now, temperature_c).any(is_ahead)
    }

    /// Median rise of the other sensors in the last `age_s` (degrees C), at least 0; `None` without two other sensors.
    fn rise_of_others(&self, now: Timestamp, sensor: usize, age_s: f64) -> Option<f64> {
        let since = now.plus_secs(-age_s);
        let others = self.sensors.iter().enumerate().filter(|(index, _)| *index != sensor);
        let rise = |(_, other): (usize, &SensorState)| {
            let (time, latest) = other.fast.0.back()?;
            (now.since(*time) <= WINDOW_S).then_some(latest - other.slow.at(since)?)
        };
        let rises: Vec<f64> = others.filter_map(rise).collect();
        median(rises.iter().copied()).filter(|_| rises.len() > 1).map(|rise| rise.max(0.0))
    }

    /// Takes new references if they are due. `least_soc`: lower bound of a cell's SOC; `None` = unknown. Returns whether
    /// the values of all cells are to be published.
    pub fn refresh(&mut self, now: Timestamp, least_soc: impl Fn(usize) -> Option<f64>) -> bool {
        let elapsed_s = self.refreshed.map_or(f64::INFINITY, |at| now.since(at));
        if (0.0..REFRESH_S).contains(&elapsed_s) {
            return false;
        }
        for (index, cell) in self.cells.iter_mut().enumerate() {
            let is_fresh = std::mem::take(&mut cell.is_fresh);
            cell.references_v = [cell.references_v[1], cell.latest_v.filter(|_| is_fresh)];
            cell.may_be_empty = least_soc(index).is_none_or(|soc| soc < ALMOST_EMPTY);
        }
        self.refreshed = Some(now);
        true
    }

    /// Evidence for a cell: 0 = none, 1 = its voltage has collapsed, 2 = its temperature rises, 3 = both; `None` = neither
    /// the voltage nor a temperature was measured. `sensor`: the cell's temperature sensor.
    pub fn evidence(&self, now: Timestamp, cell: CellIndex, sensor: Option<SensorIndex>) -> Option<f64> {
        let state = self.cells.get(cell.index())?;
        let collapsed = if is_current(state.collapsed_until, now) { 1.0 } else { 0.0 };
        let heating = if is_current(state.heating_until, now) { 2.0 } else { 0.0 };
        let sensor = sensor.and_then(|sensor| self.sensors.get(sensor.index()));
        let is_measured = state.references_v.iter().any(Option::is_some)
            || sensor.is_some_and(|sensor| sensor.slow.0.back().is_some_and(|(time, _)| now.since(*time) <= WINDOW_S));
        (is_measured || collapsed + heating > 0.0).then_some(collapsed + heating)
    }
}

impl CellState {
    /// The latest voltage relative to the highest reference.
    fn share_left(&self) -> Option<f64> {
        let reference_v =
            self.references_v.into_iter().flatten().reduce(f64::max).filter(|voltage_v| *voltage_v > 0.0)?;
        Some(self.latest_v? / reference_v)
    }

    /// Rise of the latest voltage above the lowest reference, relative to it.
    fn rise(&self) -> Option<f64> {
        let reference_v =
            self.references_v.into_iter().flatten().reduce(f64::min).filter(|voltage_v| *voltage_v > 0.0)?;
        Some(self.latest_v? / reference_v - 1.0)
    }
}

fn is_current(until: Option<Timestamp>, now: Timestamp) -> bool {
    until.is_some_and(|until| now <= until)
}

#[cfg(test)]
mod tests;
