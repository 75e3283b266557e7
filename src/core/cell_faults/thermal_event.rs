//! Detects a thermal event: the voltage of a cell collapses, or a temperature rises faster than the current explains.
//!
//! In: readings of cell voltages (V) and temperatures (degrees C), before the plausibility checks. (These checks reject
//! fast changes, and a thermal runaway causes fast changes.) Out: for each cell, whether there is evidence of a thermal
//! event.
//!
//! * **Collapse**: within half a minute, the voltage of a cell falls by the fraction [`FALL`]. It must also fall by
//!   [`FALL`] more than the median of the other cells. At least [`LEAST_READINGS`] readings over [`LEAST_S`] show the
//!   fall. The drop that the current explains is deducted. If a cell may be almost empty, it is not judged, because the
//!   voltage of an empty cell can fall as fast. Two faults do not count: a broken sense wire, which raises the voltage
//!   of a neighbour, and a dead channel, which repeats one value.
//! * **Heating**: a temperature rises by [`RATE_C_PER_S`] for [`LEAST_S`], or within [`WINDOW_S`] by [`AHEAD_C`] more
//!   than the median of the other sensors. The rise that the current explains is deducted. A second reading,
//!   [`LEAST_S`] later, must confirm the rise. If the sensor measures several cells, the finding names the cell whose
//!   voltage has fallen most.
//!
//! The first minute after a gap in the readings is not judged. [`FALL`], [`RATE_C_PER_S`] and [`LEAST_S`] are the
//! limits at which GB 38031 (appendix C) confirms a thermal runaway.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::filter::{median, square};
use crate::quantity::{CellIndex, InvalidState, SensorIndex, Timestamp};

/// Minimum fall of a voltage, as a fraction of the earlier voltage (GB 38031, appendix C).
const FALL: f64 = 0.25;
/// Minimum rate of a temperature rise that counts without comparison to other sensors (degrees C/s; GB 38031,
/// appendix C).
const RATE_C_PER_S: f64 = 1.0;
/// Minimum duration of a fall or rise (s; GB 38031, appendix C).
const LEAST_S: f64 = 3.0;
/// Minimum number of readings that show a fall, and of steps in which a temperature rises.
const LEAST_READINGS: u32 = 3;
/// Minimum lead of a temperature rise over the median rise of the other sensors (degrees C).
const AHEAD_C: f64 = 10.0;
/// Maximum time over which a fall or rise is judged (s).
const WINDOW_S: f64 = 120.0;
/// Voltage drop that a current change of 1 C explains (V). The drop of a good cell is a fifth of this value.
const EXPLAINED_V: f64 = 0.5;
/// Maximum voltage of a sound cell relative to the median of the other cells.
const HIGHEST_SHARE: f64 = 1.1;
/// Initial rate at which a current of 1 C warms a sensor (degrees C/s). Cells and busbars heat with the square of the
/// current.
const EXPLAINED_C_PER_S: f64 = 0.1;
/// Maximum rise with a current of 1 C (degrees C).
const EXPLAINED_C: f64 = 5.0;
/// Maximum difference between the rises of two sensors with a current of 1 C (degrees C).
const EXPLAINED_DIFFERENCE_C: f64 = 1.0;
/// Time constant with which the square of the current is averaged (s). A busbar cools in about a minute.
const HEAT_S: f64 = 60.0;
/// Assumed current while the current is unknown (1/h).
const UNKNOWN_RATE_PER_H: f64 = 1.0;
/// Time between two refreshes, which take reference voltages and update the published values (s).
const REFRESH_S: f64 = 30.0;
/// After its first reading, a temperature is not judged for this long (s), because the filter of its sensor is
/// settling.
const SETTLE_S: f64 = 60.0;
/// If a temperature falls by more than this between two readings (degrees C) at more than this rate (degrees C/s),
/// its sensor has failed. No cell cools so fast.
const IMPOSSIBLE_FALL: (f64, f64) = (5.0, 0.5);
/// After a failure of a sensor, only temperatures above the temperature before the failure count ([`Floor`]). This
/// condition lasts at most this long (s).
const FLOOR_S: f64 = 3600.0;
/// Evidence lasts this long after the last reading that shows it (s).
const HOLD_S: f64 = 60.0;
/// If the SOC of a cell may be below this, the cell's voltage is not judged.
const ALMOST_EMPTY: f64 = 0.1;
/// Kept readings of a sensor: minimum time between two readings (s), and maximum number of readings.
const FAST: (f64, usize) = (0.5, 8);
const SLOW: (f64, usize) = (10.0, 13);

/// Watches the cells of a pack for a thermal event.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThermalWatch {
    cells: Vec<CellState>,
    sensors: Vec<SensorState>,
    /// Number of cells whose voltage is far below its reference.
    falling: usize,
    refreshed: Option<Timestamp>,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CellState {
    latest: Option<(Timestamp, f64)>,
    /// Whether a voltage has arrived since the last refresh.
    is_fresh: bool,
    /// Voltages at the last two refreshes.
    references: [Option<Reference>; 2],
    /// Whether the cell may have been almost empty at the last refresh.
    may_be_empty: bool,
    fall: Option<Fall>,
    /// End of the evidence of a collapse.
    collapsed_until: Option<Timestamp>,
    heating_until: Option<Timestamp>,
}

/// A voltage with which later voltages are compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Reference {
    voltage_v: f64,
    /// Current at the time of the voltage (1/h); `None` = unknown.
    rate_per_h: Option<f64>,
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
    /// Time of the first reading since the start or a gap.
    first: Option<Timestamp>,
    latest: Option<(Timestamp, f64)>,
    floor: Option<Floor>,
    fast: Trail,
    slow: Trail,
    heat: f64,
    /// A reading that showed a rise and still needs confirmation.
    shown: Option<(Timestamp, f64)>,
}

/// Temperature that a sensor showed before it failed. Until the sensor has recovered, only a rise above this value
/// counts.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Floor {
    since: Timestamp,
    temperature_c: f64,
    /// Since when the readings have been near or above this temperature.
    returned: Option<Timestamp>,
}

/// Recent readings of a sensor.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
struct Trail(VecDeque<(Timestamp, f64)>);

impl Trail {
    /// Adds a reading if the previous one is at least `spacing_s` old. Removes readings that are older than
    /// [`WINDOW_S`].
    fn add(&mut self, now: Timestamp, value: f64, (spacing_s, length): (f64, usize)) {
        while self.0.front().is_some_and(|(time, _)| !(0.0..=WINDOW_S).contains(&now.since(*time))) {
            self.0.pop_front();
        }
        if self.0.back().is_none_or(|(time, _)| now.since(*time) >= spacing_s) {
            while self.0.len() >= length {
                self.0.pop_front();
            }
            self.0.push_back((now, value));
        }
    }

    /// Rises from earlier readings to `value`. An earlier reading counts if the temperature has not fallen since
    /// then, and has risen in at least [`LEAST_READINGS`] steps. The largest step is left out, because it may be a
    /// disturbance.
    fn rises(&self, now: Timestamp, value: f64) -> impl Iterator<Item = Rise> + '_ {
        let (mut next, mut steps, mut largest) = ((now, value), 0, (0.0, 0.0));
        let rises = self.0.iter().rev().map_while(move |&(time, earlier)| {
            let (step_s, step_c) = (next.0.since(time), next.1 - earlier);
            next = (time, earlier);
            steps += u32::from(step_c > 0.0);
            if step_c > largest.1 {
                largest = (step_s, step_c);
            }
            let age_s = now.since(time);
            let rise = Rise { age_s, seconds: age_s - largest.0, rise_c: value - earlier - largest.1 };
            (step_c >= 0.0 && age_s <= WINDOW_S).then(|| (steps >= LEAST_READINGS).then_some(rise))
        });
        rises.flatten()
    }

    /// The reading at `time`, or the next reading after it.
    fn at(&self, time: Timestamp) -> Option<f64> {
        self.0.iter().find(|(at, _)| *at >= time).map(|(_, value)| *value)
    }

    fn has_enough(&self, now: Timestamp) -> bool {
        let recent = self.0.iter().filter(|(at, _)| now.since(*at) <= WINDOW_S);
        recent.count() > LEAST_READINGS as usize
    }

    fn is_valid(&self, (_, length): (f64, usize)) -> bool {
        self.0.len() <= length && self.0.iter().is_sorted_by(|a, b| a.0 <= b.0)
    }
}

/// Rise of a temperature without its largest step.
#[derive(Debug, Clone, Copy)]
struct Rise {
    /// Time since the rise began (s).
    age_s: f64,
    /// Duration of the rise without its largest step (s).
    seconds: f64,
    rise_c: f64,
}

#[derive(Debug, Clone, Copy)]
struct Heat {
    square_per_h2: f64,
}

impl Heat {
    /// Rise of a sensor that the current explains within `age_s` (degrees C).
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
        let sensor = || SensorState { fast: trail(FAST), slow: trail(SLOW), ..SensorState::default() };
        let sensors = (0..sensors).map(|_| sensor()).collect();
        Self { cells: vec![CellState::default(); cells], sensors, ..Self::default() }
    }

    /// Discards the readings and the evidence, because a gap in the readings follows.
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
        let voltages = self.cells.iter().flat_map(|it| {
            let references = it.references.into_iter().flatten();
            let numbers = references.flat_map(|it| [Some(it.voltage_v), it.rate_per_h]);
            numbers.chain([it.latest.map(|it| it.1)])
        });
        let trails = self.sensors.iter().flat_map(|sensor| sensor.fast.0.iter().chain(&sensor.slow.0));
        let floors = self.sensors.iter().filter_map(|sensor| sensor.floor).map(|floor| floor.temperature_c);
        let latest = self.sensors.iter().filter_map(|sensor| Some(sensor.latest?.1));
        let temperatures = trails.map(|(_, value)| *value).chain(self.sensors.iter().map(|sensor| sensor.heat));
        let readings = voltages.flatten().chain(temperatures).chain(floors).chain(latest);
        InvalidState::unless_numbers("a reading of the thermal watch", readings)?;
        let falling = self.cells.iter().filter(|cell| cell.fall.is_some()).count();
        let has_trails = self.sensors.iter().all(|it| it.fast.is_valid(FAST) && it.slow.is_valid(SLOW));
        let is_whole = has_trails && falling == self.falling;
        InvalidState::unless(is_whole, "the number of falling cells", self.falling as f64, "as many as the cells show")
    }

    /// Handles a reading of a cell's voltage (V). `rate_per_h`: current relative to the rated capacity; `None` = unknown.
    /// Returns whether the evidence for this cell is new.
    #[inline]
    pub fn handle_voltage(
        &mut self,
        now: Timestamp,
        cell: CellIndex,
        voltage_v: f64,
        rate_per_h: impl FnOnce() -> Option<f64>,
    ) -> bool {
        let Some(state) = self.cells.get_mut(cell.index()).filter(|_| voltage_v.is_finite()) else { return false };
        (state.latest, state.is_fresh) = (Some((now, voltage_v)), true);
        if state.share_left().is_none_or(|share| share >= 1.0 - FALL) {
            self.falling -= usize::from(state.fall.take().is_some());
            return false;
        }
        self.handle_fallen(now, cell.index(), voltage_v, rate_per_h())
    }

    #[cold]
    fn handle_fallen(&mut self, now: Timestamp, cell: usize, voltage_v: f64, rate_per_h: Option<f64>) -> bool {
        let state = &mut self.cells[cell];
        self.falling += usize::from(state.fall.is_none());
        let fall = state.fall.get_or_insert(Fall { since: now, first_v: voltage_v, readings: 0, has_moved: false });
        fall.readings = fall.readings.saturating_add(1);
        fall.has_moved |= voltage_v != fall.first_v;
        let is_shown = now.since(fall.since) >= LEAST_S && fall.readings >= LEAST_READINGS && fall.has_moved;
        let was_known = is_current(state.collapsed_until, now);
        if !is_shown || state.may_be_empty || 2 * self.falling > self.cells.len() {
            return false;
        }
        if !was_known && !self.is_alone(cell, rate_per_h) {
            return false;
        }
        self.cells[cell].collapsed_until = Some(now.plus_secs(HOLD_S));
        !was_known
    }

    /// Whether the voltage of this cell alone has fallen. True if it has fallen more than the current and the other
    /// cells explain, and no neighbour's voltage has risen.
    fn is_alone(&self, cell: usize, rate_per_h: Option<f64>) -> bool {
        let others = || self.cells.iter().enumerate().filter(|(index, _)| *index != cell).map(|(_, other)| other);
        let shares: Vec<f64> = others().filter_map(CellState::share_left).collect();
        let middle_v = median(others().filter_map(CellState::reference_v));
        let own = &self.cells[cell];
        let (Some(middle), Some(middle_v)) = (median(shares.iter().copied()), middle_v) else { return false };
        let (Some((_, latest_v)), Some(reference_v), Some(fall)) = (own.latest, own.reference_v(), own.fall) else {
            return false;
        };
        let change = |before: Option<f64>| {
            rate_per_h.zip(before).map_or(UNKNOWN_RATE_PER_H, |(rate_per_h, before)| (rate_per_h - before).abs())
        };
        let changes = own.references.iter().flatten().map(|reference| change(reference.rate_per_h));
        let explained_v = EXPLAINED_V * changes.fold(0.0, f64::max);
        // If the reference is above this multiple of the median, it cannot have been the cell's true voltage.
        let share = (latest_v + explained_v) / reference_v.min(HIGHEST_SHARE * middle_v);
        let is_sound = |neighbour: &CellState| {
            let has_reported = neighbour.latest.is_some_and(|(at, _)| at >= fall.since);
            neighbour.share_left().is_none_or(|share| has_reported && share < HIGHEST_SHARE)
        };
        let around = [cell.checked_sub(1), Some(cell + 1)].into_iter().flatten();
        let mut neighbours = around.filter_map(|at| self.cells.get(at));
        shares.len() > 1 && share <= middle.min(1.0) - FALL && neighbours.all(is_sound)
    }

    /// Handles a reading of a temperature sensor (degrees C). `rate_per_h`: current relative to the rated capacity; `None`
    /// = unknown. `measures`: whether the sensor measures a cell. Returns the cell if its evidence is new.
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
        let elapsed_s = state.latest.map_or(0.0, |(latest, _)| now.since(latest)).max(0.0);
        state.note_failure(now, temperature_c, elapsed_s);
        state.heat += (present - state.heat) * -libm::expm1(-elapsed_s / HEAT_S);
        let heat = Heat { square_per_h2: state.heat.max(present) };
        if !(SETTLE_S..).contains(&now.since(*state.first.get_or_insert(now))) {
            return None;
        }
        let is_rising = self.is_rising(now, sensor.index(), temperature_c, heat);
        let state = &mut self.sensors[sensor.index()];
        state.fast.add(now, temperature_c, FAST);
        state.slow.add(now, temperature_c, SLOW);
        let is_still = |(time, value): (Timestamp, f64)| temperature_c >= value && now.since(time) <= WINDOW_S;
        state.shown = state.shown.filter(|shown| is_still(*shown));
        if !is_rising || now.since(state.shown.get_or_insert((now, temperature_c)).0) < LEAST_S {
            return None;
        }
        let of_sensor = || (0..self.cells.len()).filter(|&cell| measures(cell));
        let named = of_sensor().find(|&cell| is_current(self.cells[cell].heating_until, now));
        let share = |cell: usize| self.cells[cell].share_left().unwrap_or(1.0);
        let cell = named.or_else(|| of_sensor().min_by(|&a, &b| share(a).total_cmp(&share(b))))?;
        self.cells[cell].heating_until = Some(now.plus_secs(HOLD_S));
        named.is_none().then(|| CellIndex(u16::try_from(cell).unwrap_or(u16::MAX)))
    }

    /// Whether a temperature rises faster than the current and the other sensors explain. After a failure of the
    /// sensor, the temperature must also exceed the value before the failure.
    fn is_rising(&self, now: Timestamp, sensor: usize, temperature_c: f64, heat: Heat) -> bool {
        let state = &self.sensors[sensor];
        let floor_c = state.floor.map_or(f64::NEG_INFINITY, |floor| floor.temperature_c);
        let above_floor = |rise: Rise| Rise { rise_c: rise.rise_c.min(temperature_c - floor_c), ..rise };
        let is_fast = |Rise { age_s, seconds, rise_c }: Rise| {
            age_s >= LEAST_S && rise_c - heat.explained_c(age_s) >= RATE_C_PER_S * seconds
        };
        let least_c = AHEAD_C + heat.explained_difference_c();
        let is_ahead = |Rise { age_s, rise_c, .. }: Rise| {
            rise_c >= least_c && self.rise_of_others(now, sensor, age_s).is_some_and(|rise| rise_c - rise >= least_c)
        };
        let mut fast = state.fast.rises(now, temperature_c).map(above_floor);
        let mut slow = state.slow.rises(now, temperature_c).map(above_floor);
        (fast.any(is_fast) || slow.any(is_ahead)) && !self.is_behind_others(now, sensor, temperature_c)
    }

    /// Whether a temperature is below the median of the other sensors. Such a sensor may be recovering from a
    /// failure.
    fn is_behind_others(&self, now: Timestamp, sensor: usize, temperature_c: f64) -> bool {
        let others = self.sensors.iter().enumerate().filter(|(index, _)| *index != sensor);
        let latest = others.filter_map(|(_, other)| other.fast.0.back().filter(|(at, _)| now.since(*at) <= WINDOW_S));
        let latest: Vec<f64> = latest.map(|(_, value)| *value).collect();
        latest.len() > 1 && median(latest.iter().copied()).is_some_and(|middle| temperature_c < middle)
    }

    /// Median rise of the other sensors in the last `age_s` (degrees C), at least 0. `None` if there are fewer than
    /// two.
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

    /// Takes new references if they are due. `rate_per_h`: current of a cell relative to its rated capacity;
    /// `least_soc`: lower bound of a cell's SOC; `None` = unknown. Returns whether the caller should publish new
    /// values.
    pub fn refresh(
        &mut self,
        now: Timestamp,
        rate_per_h: impl Fn(usize) -> Option<f64>,
        least_soc: impl Fn(usize) -> Option<f64>,
    ) -> bool {
        let elapsed_s = self.refreshed.map_or(f64::INFINITY, |at| now.since(at));
        if (0.0..REFRESH_S).contains(&elapsed_s) {
            return false;
        }
        let is_judged =
            |cell: &CellState| cell.fall.is_some_and(|fall| (0.0..WINDOW_S).contains(&now.since(fall.since)));
        let judged: Vec<bool> = self.cells.iter().map(is_judged).collect();
        for (index, cell) in self.cells.iter_mut().enumerate() {
            // While a fall is judged, the cell and its neighbours keep their references.
            let around = index.saturating_sub(1)..judged.len().min(index + 2);
            if judged[around].contains(&true) {
                continue;
            }
            self.falling -= usize::from(cell.fall.take().is_some());
            let is_fresh = std::mem::take(&mut cell.is_fresh);
            let reference = |(_, voltage_v)| Reference { voltage_v, rate_per_h: rate_per_h(index) };
            cell.references = [cell.references[1], cell.latest.filter(|_| is_fresh).map(reference)];
            cell.may_be_empty = least_soc(index).is_none_or(|soc| soc < ALMOST_EMPTY);
        }
        self.refreshed = Some(now);
        true
    }

    /// Evidence for each cell: 0 = none, 1 = its voltage has collapsed, 2 = its temperature rises, 3 = both. `None`
    /// if neither its voltage nor its temperature can be judged. `sensors`: the temperature sensor of each cell.
    pub fn evidence(
        &self,
        now: Timestamp,
        sensors: &[Option<SensorIndex>],
    ) -> impl Iterator<Item = (CellIndex, Option<f64>)> {
        let compared = self.cells.iter().filter(|cell| cell.reference_v().is_some()).count();
        (0..).map(CellIndex).zip(self.cells.iter().zip(sensors)).map(move |(cell, (state, sensor))| {
            let value = state.evidence(now);
            let is_compared = compared > 2 && state.reference_v().is_some() && !state.may_be_empty;
            let sensor = sensor.and_then(|sensor| self.sensors.get(sensor.index()));
            let is_watched = || sensor.is_some_and(|sensor| sensor.slow.has_enough(now));
            (cell, (value > 0.0 || is_compared || is_watched()).then_some(value))
        })
    }

    /// Evidence for a cell, as in [`Self::evidence`].
    pub fn evidence_of(&self, now: Timestamp, cell: CellIndex) -> f64 {
        self.cells.get(cell.index()).map_or(0.0, |state| state.evidence(now))
    }
}

impl SensorState {
    /// Stores the latest reading. If the sensor failed or was silent before this reading, sets the floor: the
    /// temperature before the failure. Removes the floor after the sensor has recovered.
    fn note_failure(&mut self, now: Timestamp, temperature_c: f64, elapsed_s: f64) {
        let (least_c, rate_c_per_s) = IMPOSSIBLE_FALL;
        if let Some((_, before_c)) = self.latest.replace((now, temperature_c)) {
            let fall_c = before_c - temperature_c;
            if (fall_c > least_c && fall_c > rate_c_per_s * elapsed_s) || elapsed_s > SETTLE_S {
                // Use the median, because the latest reading may be a disturbance far above the temperature.
                let usual_c = median(self.slow.0.iter().map(|(_, value)| *value));
                let floor_c = usual_c.into_iter().chain(self.floor.map(|floor| floor.temperature_c)).reduce(f64::max);
                self.floor = floor_c.map(|temperature_c| Floor { since: now, temperature_c, returned: None });
                self.shown = None;
            }
        }
        let Some(floor) = &mut self.floor else { return };
        let is_near = temperature_c >= floor.temperature_c - least_c;
        floor.returned = floor.returned.or(Some(now)).filter(|_| is_near);
        let has_returned = floor.returned.is_some_and(|returned| now.since(returned) > WINDOW_S);
        if has_returned || !(0.0..FLOOR_S).contains(&now.since(floor.since)) {
            self.floor = None;
        }
    }
}

impl CellState {
    /// The lower of the last two references, so that a single high reading has no effect. `None` in the first minute.
    fn reference_v(&self) -> Option<f64> {
        let [before_v, last_v] = self.references.map(|reference| Some(reference?.voltage_v));
        Some(before_v?.min(last_v?)).filter(|voltage_v| *voltage_v > 0.0)
    }

    fn share_left(&self) -> Option<f64> {
        Some(self.latest?.1 / self.reference_v()?)
    }

    fn evidence(&self, now: Timestamp) -> f64 {
        let collapsed = if is_current(self.collapsed_until, now) { 1.0 } else { 0.0 };
        let heating = if is_current(self.heating_until, now) { 2.0 } else { 0.0 };
        collapsed + heating
    }
}

fn is_current(until: Option<Timestamp>, now: Timestamp) -> bool {
    until.is_some_and(|until| now <= until)
}

#[cfg(test)]
mod tests;
