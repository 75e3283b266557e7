//! Condenses readings of a vehicle's cells into rows, from which the on-board fit determines a cell model.
//!
//! In: one [`CellStep`] per voltage reading of any cell (A, V, s, degrees C). Out: at most [`MAX_ROWS`] rows of the
//! mean cell, which is the average of all cells.
//!
//! A row is a mean over a time in which the SOC hardly changes. A *stretch* is a period with a continuously measured
//! current. A row contains the voltage and all inputs from which the fit predicts it: the charge since the start of the
//! stretch, the current, and the current after first-order filters with the time constants of the branches. Each row
//! can therefore be predicted without its neighbours, and single rows can be removed.
//!
//! A mean hides current steps, so a row also contains the sums of a small regression over its steps. Rows are
//! classified by SOC, temperature and direction of the current. A full notebook removes the oldest row of the class
//! with the most rows, so that rare rows are kept.

use serde::{Deserialize, Serialize};

use super::CellStep;
use super::chemistry::TAU_S;
use crate::quantity::InvalidState;

/// Maximum number of rows. One row has 64 bytes, so the notebook stays below 8 kB.
pub const MAX_ROWS: usize = 120;
/// Below this SOC (fraction), rows and classes cover a smaller SOC range, because curves are steep and resistances
/// rise.
const LOW_SOC: f64 = 0.15;
/// Width of rows and classes below `LOW_SOC`, as a fraction of the usual width.
const LOW_SOC_PART: f64 = 0.25;
/// Width of a class (fraction of SOC).
const CLASS_SOC: f64 = 0.1;
/// Maximum current at rest, in units of the 1 C current.
const REST_PER_H: f64 = 0.02;

/// Number of current filters: one per branch of a cell model that is made from a label (chemistry and rated capacity).
pub const FILTERS: usize = 3;

/// The mean cell over a short time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Number of the stretch that contains the row.
    pub stretch: u32,
    /// SOC estimate that selects the class.
    soc: f32,
    /// Duration (s).
    pub seconds: f32,
    /// Time since the stretch began (s).
    pub elapsed_s: f32,
    /// Charge taken out since the stretch began (Ah).
    pub charge_ah: f32,
    /// Voltage (V).
    pub voltage_v: f32,
    /// Current (A).
    pub current_a: f32,
    /// Current after the filter of each branch (A).
    pub filtered_a: [f32; FILTERS],
    /// Temperature (degrees C).
    pub temperature_c: f32,
    /// Steps of the current within the row.
    pub steps: CurrentSteps,
}

/// Sums of products of the changes between two consecutive readings. i is the change of the current (A), x is the
/// change of the current after the fastest filter (A), and v is the change of the voltage (V).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurrentSteps {
    /// Sum of i i.
    pub ii: f32,
    /// Sum of i x.
    pub ix: f32,
    /// Sum of x x.
    pub xx: f32,
    /// Sum of i v.
    pub iv: f32,
    /// Sum of x v.
    pub xv: f32,
}

/// Readings that have not yet been combined into a reading of the mean cell.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Readings {
    count: u32,
    temperatures: u32,
    measured_s: f64,
    unmeasured_s: f64,
    charge_as: f64,
    current_a: f64,
    voltage_v: f64,
    temperature_c: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct RowSums {
    seconds: f64,
    elapsed_s: f64,
    charge_ah: f64,
    voltage_v: f64,
    current_a: f64,
    filtered_a: [f64; FILTERS],
    temperature_c: f64,
    steps: [f64; 5],
    /// Charge (Ah) and temperature (degrees C) at the start of the row.
    first: Option<(f64, f64)>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Stretch {
    charge_ah: f64,
    elapsed_s: f64,
    filtered_a: [f64; FILTERS],
    /// Current, current after the fastest filter, and voltage of the previous reading.
    last: [f64; 3],
    rest_s: f64,
    row: RowSums,
}

/// Position in the present stretch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PresentStretch {
    /// Number of the stretch.
    pub number: u32,
    /// Charge taken out so far (Ah).
    pub charge_ah: f64,
    /// Time since the stretch began (s).
    pub elapsed_s: f64,
}

/// The notebook of a pack.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Notebook {
    rows: Vec<Row>,
    number: u32,
    unread: u32,
    readings: Readings,
    present: Option<Stretch>,
}

/// Settings for turning readings into rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NotebookConfig {
    /// Number of cells that report.
    pub cells: u32,
    /// Rated capacity of a cell (Ah).
    pub rated_ah: f64,
    /// Time constants of the filters (s), rising.
    pub tau_s: [f64; FILTERS],
}

impl NotebookConfig {
    /// Settings for a pack whose cell model is made from a label.
    pub fn new(cells: u32, rated_ah: f64) -> Self {
        Self { cells, rated_ah, tau_s: TAU_S }
    }

    fn rest_a(&self) -> f64 {
        REST_PER_H * self.rated_ah
    }
}

impl Notebook {
    /// The rows in chronological order.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Number of rows added since the last [`Self::mark_read`] that are still present.
    pub fn unread(&self) -> usize {
        self.unread as usize
    }

    /// Marks all rows as read.
    pub fn mark_read(&mut self) {
        self.unread = 0;
    }

    /// Returns the notebook with all rows marked as unread.
    pub fn all_unread(self) -> Self {
        Self { unread: u32::try_from(self.rows.len()).unwrap_or(u32::MAX), ..self }
    }

    /// The unread rows.
    pub fn new_rows(&self) -> &[Row] {
        &self.rows[self.rows.len().saturating_sub(self.unread as usize)..]
    }

    /// Charge moved in either direction in the unread rows (Ah).
    pub fn new_charge_ah(&self) -> f64 {
        let first = self.rows.len() - self.new_rows().len();
        let moved = |pair: &[Row]| {
            let same = pair[0].stretch == pair[1].stretch;
            if same { f64::from((pair[1].charge_ah - pair[0].charge_ah).abs()) } else { 0.0 }
        };
        self.rows[first.saturating_sub(1)..].windows(2).map(moved).sum()
    }

    /// Number of unread rows whose class (SOC, temperature and direction) has no earlier row.
    pub fn rows_of_new_classes(&self, rated_ah: f64) -> usize {
        let (old, new) = self.rows.split_at(self.rows.len() - self.new_rows().len());
        new.iter().filter(|row| old.iter().all(|old| old.class(rated_ah) != row.class(rated_ah))).count()
    }

    /// Position in the present stretch.
    pub fn present(&self) -> Option<PresentStretch> {
        let of =
            |it: &Stretch| PresentStretch { number: self.number, charge_ah: it.charge_ah, elapsed_s: it.elapsed_s };
        self.present.as_ref().map(of)
    }

    /// Present current after each filter (A); `None` outside a stretch.
    pub fn filtered_a(&self) -> Option<[f64; FILTERS]> {
        self.present.as_ref().map(|stretch| stretch.filtered_a)
    }

    /// Adds a reading. If it returns true, a row is complete, and the caller must call [`Self::close_row`].
    #[inline]
    pub fn add(&mut self, config: &NotebookConfig, step: &CellStep) -> bool {
        let readings = &mut self.readings;
        readings.measured_s += step.measured_s;
        readings.unmeasured_s += step.unmeasured_s;
        readings.charge_as += step.charge_as;
        if let Some(current_a) = step.current_a {
            readings.count += 1;
            readings.current_a += current_a;
            readings.voltage_v += step.voltage_v;
        }
        if let Some(temperature_c) = step.temperature_c {
            readings.temperatures += 1;
            readings.temperature_c += temperature_c;
        }
        // The mean cell has at most one reading per second.
        let is_due = readings.count >= config.cells && readings.measured_s >= f64::from(config.cells);
        // Outside a stretch, one reading per cell begins a stretch, even without measured time.
        let begins = self.present.is_none() && readings.count >= config.cells;
        (is_due || begins) && self.close_readings(config, step.ambient_c)
    }

    /// Combines the readings into one reading of the mean cell. Returns whether a row is complete.
    fn close_readings(&mut self, config: &NotebookConfig, ambient_c: f64) -> bool {
        let Readings { count, temperatures, measured_s, unmeasured_s, charge_as, current_a, voltage_v, temperature_c } =
            std::mem::take(&mut self.readings);
        let (cells, count) = (f64::from(config.cells), f64::from(count));
        let temperature_c = if temperatures > 0 { temperature_c / f64::from(temperatures) } else { ambient_c };
        let (dt_s, current_a, voltage_v) = (measured_s / cells, current_a / count, voltage_v / count);
        // If the current was unmeasured for more than 10 s, the stretch ends. `unmeasured_s` is a sum over all cells.
        if unmeasured_s > 10.0 * cells {
            self.end_stretch(config);
        }
        let last = self.rows.last().filter(|row| row.stretch == self.number);
        let last_soc = last.map(|row| (f64::from(row.soc), f64::from(row.charge_ah)));
        let Some(stretch) = &mut self.present else {
            self.number = self.number.wrapping_add(1);
            // The previous load is unknown, so the branches are assumed to be settled.
            let filtered_a = [current_a; FILTERS];
            let last = [current_a, current_a, voltage_v];
            self.present = Some(Stretch {
                charge_ah: 0.0,
                elapsed_s: 0.0,
                filtered_a,
                last,
                rest_s: 0.0,
                row: RowSums::default(),
            });
            return false;
        };
        let mean_a = charge_as / measured_s;
        let before_a = stretch.filtered_a;
        for (filtered_a, tau_s) in stretch.filtered_a.iter_mut().zip(config.tau_s) {
            *filtered_a = mean_a + libm::exp(-dt_s / tau_s) * (*filtered_a - mean_a);
        }
        let charge_before_ah = stretch.charge_ah;
        stretch.charge_ah += charge_as / cells / 3600.0;
        stretch.elapsed_s += dt_s;
        // One reading per cell represents the end of its interval. The mean of several readings represents the middle.
        let late = if count > cells { 0.5 } else { 1.0 };
        let along = |before: f64, after: f64| before + late * (after - before);
        let filtered_a: [f64; FILTERS] = std::array::from_fn(|i| along(before_a[i], stretch.filtered_a[i]));
        let charge_ah = along(charge_before_ah, stretch.charge_ah);
        stretch.rest_s = if mean_a.abs() > config.rest_a() { 0.0 } else { stretch.rest_s + dt_s };
        let [i, x, v] = [current_a, filtered_a[0], voltage_v];
        let [last_i, last_x, last_v] = std::mem::replace(&mut stretch.last, [i, x, v]);
        let row = &mut stretch.row;
        // The change between readings more than 3 s apart is not a step.
        if dt_s <= 3.0 {
            let [di, dx, dv] = [i - last_i, x - last_x, v - last_v];
            let products = [di * di, di * dx, dx * dx, di * dv, dx * dv];
            row.steps.iter_mut().zip(products).for_each(|(sum, product)| *sum += product);
        }
        let (first_ah, first_c) = *row.first.get_or_insert((charge_ah, temperature_c));
        row.seconds += dt_s;
        row.elapsed_s += dt_s * stretch.elapsed_s;
        row.charge_ah += dt_s * charge_ah;
        row.voltage_v += dt_s * voltage_v;
        row.current_a += dt_s * current_a;
        row.temperature_c += dt_s * temperature_c;
        row.filtered_a.iter_mut().zip(filtered_a).for_each(|(sum, filtered_a)| *sum += dt_s * filtered_a);
        let soc = last_soc.map_or(1.0, |(soc, last_ah)| soc - (charge_ah - last_ah) / config.rated_ah);
        let part = if soc < LOW_SOC { LOW_SOC_PART } else { 1.0 };
        (charge_ah - first_ah).abs() >= part * 0.02 * config.rated_ah
            // At rest, a row takes at least half as long as the rest so far, so that a night gives only a few rows.
            || row.seconds >= f64::max(300.0, 0.5 * stretch.rest_s)
            || (temperature_c - first_c).abs() >= 4.0
    }

    /// Ends the present row. `soc` is its estimated SOC.
    pub fn close_row(&mut self, config: &NotebookConfig, soc: f64) {
        let Some(stretch) = &mut self.present else { return };
        let sums = std::mem::take(&mut stretch.row);
        if sums.seconds <= 0.0 {
            return;
        }
        let mean = |sum: f64| (sum / sums.seconds) as f32;
        let [ii, ix, xx, iv, xv] = sums.steps.map(|sum| sum as f32);
        let row = Row {
            stretch: self.number,
            soc: soc as f32,
            seconds: sums.seconds as f32,
            elapsed_s: mean(sums.elapsed_s),
            charge_ah: mean(sums.charge_ah),
            voltage_v: mean(sums.voltage_v),
            current_a: mean(sums.current_a),
            filtered_a: sums.filtered_a.map(mean),
            temperature_c: mean(sums.temperature_c),
            steps: CurrentSteps { ii, ix, xx, iv, xv },
        };
        self.rows.push(row);
        self.unread = self.unread.saturating_add(1);
        self.make_room(config);
    }

    /// Ends the present row when the vehicle rests or the stretch ends. Does nothing if the row is shorter than 20 s or
    /// the first row of the stretch.
    pub fn finish_row(&mut self, config: &NotebookConfig) {
        let before = self.rows.last().filter(|row| row.stretch == self.number).copied();
        if let (Some(stretch), Some(before)) = (&self.present, before)
            && stretch.row.seconds >= 20.0
        {
            let moved_ah = stretch.charge_ah - f64::from(before.charge_ah);
            self.close_row(config, f64::from(before.soc) - moved_ah / config.rated_ah);
        }
    }

    /// Ends the present stretch.
    pub fn end_stretch(&mut self, config: &NotebookConfig) {
        self.finish_row(config);
        (self.readings, self.present) = (Readings::default(), None);
    }

    fn make_room(&mut self, config: &NotebookConfig) {
        let class_of = |row: &Row| row.class(config.rated_ah);
        // Each stretch adds a parameter to the fit (its initial SOC), so at most 16 stretches are kept.
        if self.rows.chunk_by(|a, b| a.stretch == b.stretch).count() > 16
            && let Some(dropped) = self.least_missed(config)
        {
            let unread_from = self.rows.len() - self.new_rows().len();
            let unread = self.rows[unread_from..].iter().filter(|row| row.stretch != dropped).count();
            self.rows.retain(|row| row.stretch != dropped);
            self.unread = u32::try_from(unread).unwrap_or(u32::MAX);
        }
        while self.rows.len() > MAX_ROWS {
            let classes: Vec<_> = self.rows.iter().map(class_of).collect();
            let size = |at: usize| classes.iter().filter(|class| **class == classes[at]).count();
            let fullest = (0..classes.len()).rev().max_by_key(|&at| size(at)).unwrap_or(0);
            let oldest = classes.iter().position(|class| *class == classes[fullest]).unwrap_or(0);
            if oldest >= self.rows.len() - self.new_rows().len() {
                self.unread -= 1;
            }
            self.rows.remove(oldest);
        }
    }

    /// The past stretch with the fewest rows whose class occurs in no other stretch. If several stretches qualify,
    /// returns the oldest.
    fn least_missed(&self, config: &NotebookConfig) -> Option<u32> {
        let class_of = |row: &Row| row.class(config.rated_ah);
        let alone = |stretch: &[Row]| {
            let has_other =
                |row: &&Row| self.rows.iter().any(|it| it.stretch != row.stretch && class_of(it) == class_of(row));
            stretch.iter().filter(|row| !has_other(row)).count()
        };
        let stretches = self.rows.chunk_by(|a, b| a.stretch == b.stretch).filter(|rows| rows[0].stretch != self.number);
        stretches.min_by_key(|rows| alone(rows)).map(|rows| rows[0].stretch)
    }

    /// Checks the numbers of a stored notebook.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless(
            self.rows.len() <= MAX_ROWS,
            "the rows of the notebook",
            self.rows.len() as f64,
            "at most 120",
        )?;
        for row in &self.rows {
            let CurrentSteps { ii, ix, xx, iv, xv } = row.steps;
            let [a, b, c] = row.filtered_a;
            let numbers =
                [row.soc, row.elapsed_s, row.charge_ah, row.voltage_v, row.current_a, row.temperature_c, a, b, c];
            let all = numbers.into_iter().chain([ii, ix, xx, iv, xv]).map(f64::from);
            InvalidState::unless_numbers("a number of the notebook", all)?;
            InvalidState::unless_positive("the duration of a row of the notebook", f64::from(row.seconds))?;
        }
        let Some(Stretch { charge_ah, elapsed_s, filtered_a, last, rest_s, row }) = &self.present else {
            return Ok(());
        };
        let numbers = filtered_a.iter().chain(last).chain(&row.filtered_a).chain(&row.steps).copied();
        let sums = [
            *charge_ah,
            *elapsed_s,
            *rest_s,
            row.elapsed_s,
            row.charge_ah,
            row.voltage_v,
            row.current_a,
            row.temperature_c,
            row.seconds,
        ];
        InvalidState::unless_numbers("a number of the notebook", numbers.chain(sums))
    }
}

impl Row {
    /// SOC estimate (fraction).
    pub fn soc(&self) -> f64 {
        f64::from(self.soc)
    }

    fn class(&self, rated_ah: f64) -> (i32, i32, i32) {
        let rest_a = REST_PER_H * rated_ah;
        let current_a = f64::from(self.current_a);
        let direction = if current_a > rest_a { 1 } else { -i32::from(current_a < -rest_a) };
        let step = |value: f32, width: f64| (f64::from(value) / width).floor().clamp(-100.0, 100.0) as i32;
        let soc_width = if f64::from(self.soc) < LOW_SOC { LOW_SOC_PART * CLASS_SOC } else { CLASS_SOC };
        (step(self.soc, soc_width), step(self.temperature_c, 10.0), direction)
    }
}
