//! Outlook: energy, time and power that a pack can deliver or take up from now on.
//!
//! In: state and model of every cell ([`CellNow`]), the recent load ([`RecentLoad`]) and the limits
//! ([`OutlookConfig`]). Out: [`Outlook`] of the pack, with variances. Currents are per cell, positive = discharge.
//!
//! * A discharge ends when the first cell is empty, and a charge ends when the first cell is full. All cells of a
//!   series pack carry the same charge. Energy is the integral of the cells' voltages over this charge, less the losses
//!   at the recent load.
//! * A charge continues at the recent current until the first cell reaches its highest voltage. Then the charger holds
//!   this voltage, and the current falls until it reaches the taper current.
//! * Power is stated for each duration in [`POWER_S`]. It is the product of current and voltage at the end of the
//!   duration. The current is the largest constant current that keeps every cell within its voltage limits. Current and
//!   voltage follow from the step response of the equivalent circuit.
//!
//! Variances are propagated to first order from SOC, capacity and resistance of the limiting cell.

use serde::{Deserialize, Serialize};

use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, GridPosition, MAX_BRANCHES, TemperaturePosition, USUAL_LOAD_PER_H};
use crate::filter::{ScalarGaussian, bisect, square};
use crate::quantity::{CellIndex, InvalidState, Mode, Timestamp};

/// Times for which the power is stated (s).
pub const POWER_S: [f64; 3] = [2.0, 10.0, 30.0];
/// Time over which the load of a discharge is averaged (s). Half an hour includes fast and slow parts of a drive.
const LOAD_S: f64 = 1800.0;
/// Standard deviation of ln(charging time that the taper adds). It is large, because the current of a model without a
/// slow branch falls too fast.
const LOG_HELD_STD: f64 = 0.7;
/// A load is known if its mean is at least this share of its RMS value. If the mean is smaller, charge and discharge
/// alternate, as in a hybrid, and no time to empty can be forecast.
const LEAST_MEAN: f64 = 0.1;
/// Standard deviation of ln(future load over recent load): a driver needs a third more or less in the next half hour.
const LOG_LOAD_STD: f64 = 0.3;
/// Time over which the current of a charge is averaged (s). A charger regulates its current. Braking ends sooner, so a
/// charge counts only after this time. If more time than this lies between two currents, the later current is not
/// averaged.
const CHARGER_S: f64 = 60.0;
/// Number of halvings in a search for a SOC, for a resolution of 0.02 %.
const HALVINGS: u32 = 12;
/// Number of Newton steps in the search for the current at a voltage limit.
const CURRENT_STEPS: u32 = 5;
/// Number of intervals of an integral over the charge.
const INTERVALS: u32 = 8;
/// Number of steps of a charge.
const CHARGE_STEPS: u32 = 64;

/// Limits of a cell, and settings for the end of a charge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutlookConfig {
    /// Lowest voltage (V); `None` = the cell model's lowest voltage.
    pub min_voltage_v: Option<f64>,
    /// Highest voltage (V); `None` = the cell model's highest voltage.
    pub max_voltage_v: Option<f64>,
    /// Largest current of a discharge (A); `None` = only the voltages limit it.
    pub max_discharge_a: Option<f64>,
    /// Largest current of a charge (A); `None` = only the voltages limit it.
    pub max_charge_a: Option<f64>,
    /// Lowest permitted temperature (degrees C); `None` = no limit. Only the record of the pack's use applies it.
    pub min_temperature_c: Option<f64>,
    /// Highest permitted temperature (degrees C); `None` = no limit. Only the record of the pack's use applies it.
    pub max_temperature_c: Option<f64>,
    /// A charge is complete when its current has fallen to this value (A).
    pub taper_current_a: f64,
    /// SOC for which the time of a charge is stated, fraction.
    pub target_soc: f64,
}

/// Averages of the current while the pack is discharged, and while it is charged.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecentLoad {
    latest: Option<Timestamp>,
    discharge: Average,
    charge: Average,
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Average {
    /// Time that the average covers so far, at most its window (s).
    seconds: f64,
    mean_a: f64,
    mean_square_a2: f64,
    /// Largest recent current (A). It decays towards the mean with the time constant of the window.
    peak_a: f64,
}

impl Average {
    fn add(&mut self, current_a: f64, seconds: f64, window_s: f64) {
        self.seconds = (self.seconds + seconds).min(window_s);
        let weight = (seconds / self.seconds.max(f64::MIN_POSITIVE)).min(1.0);
        self.mean_a += weight * (current_a - self.mean_a);
        self.mean_square_a2 += weight * (square(current_a) - self.mean_square_a2);
        self.peak_a = current_a.max(self.peak_a + weight * (self.mean_a - self.peak_a));
    }

    /// The load; `None` if its mean is below [`LEAST_MEAN`] of its RMS value.
    fn load(&self) -> Option<Load> {
        let Self { mean_a, mean_square_a2, peak_a, .. } = *self;
        let is_known = mean_a > LEAST_MEAN * mean_square_a2.sqrt();
        is_known.then(|| Load {
            mean_a,
            mean_square_a2: mean_square_a2.max(square(mean_a)),
            peak_a: peak_a.max(mean_a),
        })
    }
}

impl RecentLoad {
    /// Adds the current of a cell at `now`; `None` = the current is unknown. If the mode is rest or unknown, a current of
    /// at most `rest_a` is not averaged.
    pub fn observe(&mut self, now: Timestamp, mode: Mode, current_a: Option<f64>, rest_a: f64) {
        let seconds = self.latest.map_or(0.0, |latest| now.since(latest));
        self.latest = Some(now);
        let Some(current_a) = current_a.filter(|_| seconds > 0.0 && seconds <= CHARGER_S) else { return };
        match mode {
            Mode::Charge => self.charge.add(-current_a, seconds, CHARGER_S),
            Mode::Rest | Mode::Unknown if current_a.abs() <= rest_a => self.charge = Average::default(),
            // If the current changes its sign every few seconds, the mode is unknown. The current still counts as load.
            Mode::Discharge | Mode::Rest | Mode::Unknown => {
                self.charge = Average::default();
                self.discharge.add(current_a, seconds, LOAD_S);
            }
        }
    }

    /// After a sleep or a restart, forgets the time of the latest current, so that the pause is not averaged.
    pub fn interrupt(&mut self) {
        self.latest = None;
    }

    /// The charger's current (A, positive), if the pack is being charged.
    fn charger_a(&self, mode: Mode) -> Option<f64> {
        let is_charger = mode == Mode::Charge && self.charge.seconds >= CHARGER_S;
        Some(self.charge.mean_a).filter(|current_a| is_charger && *current_a > 0.0)
    }

    /// Shifts the time of the latest current by `by_nanos`, to another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        self.latest = self.latest.map(|latest| latest.plus_nanos(by_nanos));
    }

    /// Checks the numbers of a stored state.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        [self.discharge, self.charge].iter().try_for_each(|average| {
            InvalidState::unless_natural("the time of an averaged current", average.seconds)?;
            InvalidState::unless_natural("the mean square of a current", average.mean_square_a2)?;
            InvalidState::unless_numbers("a mean or largest current", [average.mean_a, average.peak_a])
        })
    }
}

/// A load per cell: mean, mean square and largest current, positive.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Load {
    mean_a: f64,
    mean_square_a2: f64,
    peak_a: f64,
}

impl Load {
    fn constant(mean_a: f64) -> Self {
        Self { mean_a, mean_square_a2: square(mean_a), peak_a: mean_a }
    }

    /// The load that is assumed while no load is known: C/2 with a largest current of 1C.
    fn usual(rated_ah: f64) -> Self {
        Self { peak_a: rated_ah, ..Self::constant(USUAL_LOAD_PER_H * rated_ah) }
    }

    /// Energy lost per charge (V). The mean current flows through the settled resistance. The fluctuations of the
    /// current flow through the fast resistance.
    fn loss_v(&self, settled_ohm: f64, fast_ohm: f64) -> f64 {
        let fluctuation_a = (self.mean_square_a2 - square(self.mean_a)) / self.mean_a;
        self.mean_a * settled_ohm + fluctuation_a * fast_ohm
    }

    /// The load with all currents multiplied by `factor`.
    fn times(&self, factor: f64) -> Self {
        let Self { mean_a, mean_square_a2, peak_a } = *self;
        Self { mean_a: factor * mean_a, mean_square_a2: square(factor) * mean_square_a2, peak_a: factor * peak_a }
    }

    /// Voltage drop at the largest current (V).
    fn peak_v(&self, settled_ohm: f64, fast_ohm: f64) -> f64 {
        self.mean_a * settled_ohm + (self.peak_a - self.mean_a) * fast_ohm
    }
}

/// State and model of one cell.
#[derive(Debug, Clone, Copy)]
pub struct CellNow<'a> {
    pub model: &'a CellModel,
    /// State of charge, fraction.
    pub soc: ScalarGaussian,
    /// Capacity (Ah).
    pub capacity: ScalarGaussian,
    /// Resistance relative to the model.
    pub resistance_ratio: f64,
    /// Standard deviation of ln(resistance ratio), including the model's own error at this SOC and temperature.
    pub log_resistance_std: f64,
    /// Additional resistance ratio of the slowest branch.
    pub slow_ratio: f64,
    /// Voltages of the branches (V).
    pub branch_v: [f64; MAX_BRANCHES],
    /// Position of the temperature in the model's tables.
    pub temperature: TemperaturePosition,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Direction {
    Discharge,
    Charge,
}

impl CellNow<'_> {
    fn min_v(&self, config: &OutlookConfig) -> f64 {
        config.min_voltage_v.unwrap_or(self.model.voltage_min_v)
    }

    fn max_v(&self, config: &OutlookConfig) -> f64 {
        config.max_voltage_v.unwrap_or(self.model.voltage_max_v)
    }

    fn position(&self, soc: f64) -> GridPosition {
        self.model.grid_position_at(&self.temperature, soc)
    }

    fn ocv_v(&self, at: &GridPosition) -> f64 {
        self.model.aged_ocv_v(at, self.capacity.mean)
    }

    /// Resistance (ohm) `after_s` after a step of the current.
    fn ohm(&self, at: &GridPosition, after_s: f64) -> f64 {
        self.resistance(at, |tau_s| 1.0 - libm::exp(-after_s / tau_s))
    }

    /// Resistance (ohm) of the settled circuit.
    fn settled_ohm(&self, at: &GridPosition) -> f64 {
        self.resistance(at, |_| 1.0)
    }

    /// Resistance (ohm). `share` maps the time constant of a branch (s) to the fraction of its resistance that counts.
    fn resistance(&self, at: &GridPosition, share: impl Fn(f64) -> f64) -> f64 {
        let model = self.model;
        let slowest = model.branches.len() - 1;
        let response = |i: usize| {
            let ratio = if i == slowest { self.slow_ratio } else { 1.0 };
            ratio * model.branch_r_ohm(i, at) * share(model.branch_tau_s(i, at))
        };
        self.resistance_ratio * (0..=slowest).fold(model.r0_ohm(at), |sum, i| sum + response(i))
    }

    /// Mean voltage at a load (V), at least the lowest voltage.
    fn loaded_v(&self, soc: f64, load: &Load, config: &OutlookConfig) -> f64 {
        let at = &self.position(soc);
        let loss_v = load.loss_v(self.settled_ohm(at), self.ohm(at, POWER_S[1]));
        (self.ocv_v(at) - loss_v).max(self.min_v(config))
    }

    /// SOC at which the voltage at the largest current of the load falls to the lowest voltage.
    fn empty_soc(&self, load: &Load, config: &OutlookConfig) -> f64 {
        let is_empty = |soc: f64| {
            let at = &self.position(soc);
            let peak_v = load.peak_v(self.settled_ohm(at), self.ohm(at, POWER_S[0]));
            self.ocv_v(at) - peak_v < self.min_v(config)
        };
        if is_empty(0.0) { bisect((0.0, 1.0), HALVINGS, is_empty).1 } else { 0.0 }
    }

    /// Charge (Ah) that the cell delivers at this load until it is empty.
    fn dischargeable_ah(&self, load: &Load, config: &OutlookConfig) -> f64 {
        self.capacity.mean * (self.soc.mean - self.empty_soc(load, config)).max(0.0)
    }

    /// Charge (Ah) that the cell takes up until it is full. It is full when the taper current keeps it at its highest
    /// voltage.
    fn chargeable_ah(&self, config: &OutlookConfig) -> f64 {
        let soc = self.soc.mean;
        let (full, _) = bisect((soc.min(1.0), 1.0), HALVINGS, |soc| self.held_a(soc, config) > config.taper_current_a);
        let full = if self.held_a(1.0, config) > config.taper_current_a { 1.0 } else { full };
        self.capacity.mean * (full - soc).max(0.0)
    }

    /// Charging current (A) that keeps the cell at its highest voltage.
    fn held_a(&self, soc: f64, config: &OutlookConfig) -> f64 {
        let at = &self.position(soc);
        (self.max_v(config) - self.ocv_v(at)) / self.settled_ohm(at)
    }

    /// Energy (Wh) that the cell delivers with the charge `charge_ah` at this load.
    fn delivered_wh(&self, charge_ah: f64, load: &Load, config: &OutlookConfig) -> f64 {
        let at = |part: f64| self.loaded_v(self.soc.mean - part * charge_ah / self.capacity.mean, load, config);
        charge_ah * mean_of(at)
    }

    /// Energy (Wh) that the cell takes up with the charge `charge_ah` at a constant current.
    fn taken_wh(&self, charge_ah: f64, current_a: f64, config: &OutlookConfig) -> f64 {
        let at = |part: f64| {
            let at = &self.position(self.soc.mean + part * charge_ah / self.capacity.mean);
            (self.ocv_v(at) + current_a * self.settled_ohm(at)).min(self.max_v(config))
        };
        charge_ah * mean_of(at)
    }

    /// Time (s) in which the cell takes up `charge_ah` from a charger that delivers `current_a` until the cell reaches
    /// its highest voltage.
    fn charging_s(&self, charge_ah: f64, current_a: f64, config: &OutlookConfig) -> f64 {
        let step_ah = charge_ah / f64::from(CHARGE_STEPS);
        (0..CHARGE_STEPS).fold(0.0, |sum_s, step| {
            let soc = self.soc.mean + (f64::from(step) + 0.5) * step_ah / self.capacity.mean;
            let held_a = self.held_a(soc, config).max(config.taper_current_a);
            sum_s + 3600.0 * step_ah / current_a.min(held_a)
        })
    }

    /// Open-circuit voltage minus the voltages of the relaxing branches (V), and resistance (ohm). Both values apply
    /// `after_s` after the current has changed to `current_a` (positive = discharge).
    fn response(&self, current_a: f64, after_s: f64) -> (f64, f64) {
        let (model, now) = (self.model, &self.position(self.soc.mean));
        let moved = current_a * after_s / (3600.0 * self.capacity.mean);
        let [middle, end] = [0.5, 1.0].map(|part| self.position(self.soc.mean - part * moved));
        let relaxing_v = (0..model.branches.len())
            .map(|i| self.branch_v[i] * libm::exp(-after_s / model.branch_tau_s(i, now)))
            .sum::<f64>();
        (self.ocv_v(&end) - relaxing_v, self.ohm(&middle, after_s))
    }

    /// Largest current (A, positive) in a direction that keeps the cell within its limits for `for_s`.
    fn limit_a(&self, direction: Direction, for_s: f64, config: &OutlookConfig) -> f64 {
        let (sign, room, max_a, limit_v) = match direction {
            Direction::Discharge => (1.0, self.soc.mean, config.max_discharge_a, self.min_v(config)),
            Direction::Charge => (-1.0, 1.0 - self.soc.mean, config.max_charge_a, self.max_v(config)),
        };
        let soc_per_a = for_s / (3600.0 * self.capacity.mean);
        let most_a = max_a.unwrap_or(f64::INFINITY).min(room.max(0.0) / soc_per_a);
        (0..CURRENT_STEPS).fold(0.0, |current_a, _| {
            let (open_v, ohm) = self.response(sign * current_a, for_s);
            let moved = self.position(self.soc.mean - sign * current_a * soc_per_a);
            let slope_ohm = ohm + self.model.ocv_slope_v(&moved, self.capacity.mean) * soc_per_a;
            let beyond_v = sign * (open_v - limit_v) - current_a * ohm;
            (current_a + beyond_v / slope_ohm).clamp(0.0, most_a)
        })
    }

    /// Voltage (V) after `after_s` of a current in a direction (A, positive).
    fn voltage_after(&self, direction: Direction, current_a: f64, after_s: f64) -> f64 {
        let signed_a = if direction == Direction::Discharge { current_a } else { -current_a };
        let (open_v, ohm) = self.response(signed_a, after_s);
        (open_v - signed_a * ohm).max(0.0)
    }

    /// A value of the cell with its variance. `value` is computed again with SOC, capacity and ln(resistance) each one
    /// standard deviation higher and lower. The larger change counts, because a SOC of 0 or 1 can change in only one
    /// direction.
    fn spread(&self, value: impl Fn(&Self) -> f64) -> ScalarGaussian {
        let mean = value(self);
        let part = |change: fn(&mut Self, f64)| {
            let changes = [-1.0, 1.0].map(|sigmas| {
                let mut other = *self;
                change(&mut other, sigmas);
                square(value(&other) - mean)
            });
            changes[0].max(changes[1])
        };
        let variance = part(|cell, sigmas| cell.soc.mean = (cell.soc.mean + sigmas * cell.soc.std()).clamp(0.0, 1.0))
            + part(|cell, sigmas| {
                let capacity_ah = cell.capacity.mean + sigmas * cell.capacity.std();
                cell.capacity.mean = capacity_ah.max(0.1 * cell.capacity.mean);
            })
            + part(|cell, sigmas| cell.resistance_ratio *= libm::exp(sigmas * cell.log_resistance_std));
        ScalarGaussian { mean, variance }
    }
}

/// Mean of `value` over 0 to 1, by the midpoint rule.
fn mean_of(value: impl Fn(f64) -> f64) -> f64 {
    let middle = |k: u32| (f64::from(k) + 0.5) / f64::from(INTERVALS);
    (0..INTERVALS).map(|k| value(middle(k))).sum::<f64>() / f64::from(INTERVALS)
}

/// What the pack can deliver and take up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outlook {
    /// Energy until the first cell is empty, at the recent load (Wh).
    pub remaining_wh: ScalarGaussian,
    /// Energy that the pack takes up until the first cell is full, at the recent current of the charge (Wh).
    pub to_full_wh: ScalarGaussian,
    /// Time until the first cell is empty at the recent load (s); `None` unless the pack is discharged.
    pub to_empty_s: Option<ScalarGaussian>,
    /// Time until the first cell is full, at the charger's recent current (s); `None` unless the pack is charged.
    pub to_full_s: Option<ScalarGaussian>,
    /// Time until the pack reaches the configured SOC (s); `None` unless the pack is charged.
    pub to_target_s: Option<ScalarGaussian>,
    /// Discharge power for each time in [`POWER_S`] (W).
    pub discharge_w: [ScalarGaussian; 3],
    /// Charge power for each time in [`POWER_S`] (W).
    pub charge_w: [ScalarGaussian; 3],
    /// The cell that limits the 10 s discharge power, and the cell that limits the 10 s charge power.
    pub limiting_cells: [CellIndex; 2],
}

/// Structure of the pack.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Structure {
    /// Cells in series per [`CellNow`]: 1, or the number of cells if only the pack's total voltage is measured.
    pub series_per_state: f64,
    pub strings: f64,
    /// State of charge of the pack, fraction.
    pub soc: f64,
    /// Capacity of the pack per string (Ah).
    pub capacity_ah: f64,
}

/// Computes the outlook of a pack; `None` without cells.
pub fn of_pack(
    config: &OutlookConfig,
    (load, mode): (&RecentLoad, Mode),
    cells: &[CellNow<'_>],
    pack: &Structure,
) -> Option<Outlook> {
    let rated_ah = cells.first()?.model.rated_capacity_ah;
    let discharge = load.discharge.load();
    let drawn = discharge.unwrap_or(Load::usual(rated_ah));
    let charger = load.charger_a(mode);
    let charger_a = charger.unwrap_or(USUAL_LOAD_PER_H * rated_ah);
    // If the charger delivers less than the taper current, the charge ends when the first cell reaches its highest
    // voltage.
    let config = &OutlookConfig { taper_current_a: config.taper_current_a.min(charger_a), ..*config };
    let least = |value: &dyn Fn(&CellNow<'_>) -> f64| {
        cells.iter().map(|cell| (value(cell), cell)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, cell)| cell)
    };
    let weakest = least(&|cell| cell.dischargeable_ah(&drawn, config))?;
    let fullest = least(&|cell| cell.chargeable_ah(config))?;
    let sum = |value: &dyn Fn(&CellNow<'_>) -> f64| {
        pack.strings * pack.series_per_state * cells.iter().map(value).sum::<f64>()
    };
    // The errors of all cells are assumed to be equal, because the cells share the current sensor and the model.
    let whole = |one: ScalarGaussian, value: &dyn Fn(&CellNow<'_>) -> f64| ScalarGaussian {
        mean: sum(value),
        variance: square(sum(&|_| 1.0)) * one.variance,
    };
    // Computes a value of the weakest cell at this load. The variance contains the errors of the cell and of the future
    // load.
    let loaded = |load: Load, value: &dyn Fn(&CellNow<'_>, &Load) -> f64| {
        let known = weakest.spread(|cell| value(cell, &load));
        let changes = [-LOG_LOAD_STD, LOG_LOAD_STD].map(|log| value(weakest, &load.times(libm::exp(log))) - known.mean);
        ScalarGaussian { variance: known.variance + square(changes[0]).max(square(changes[1])), ..known }
    };
    let drawn_ah = weakest.dischargeable_ah(&drawn, config);
    let energy = loaded(drawn, &|cell, load| cell.delivered_wh(cell.dischargeable_ah(load, config), load, config));
    let to_empty_s = discharge
        .filter(|_| mode == Mode::Discharge)
        .map(|load| loaded(load, &|cell, load| 3600.0 * cell.dischargeable_ah(load, config) / load.mean_a));
    let taken_ah = fullest.chargeable_ah(config);
    let to_full = fullest.spread(|cell| cell.taken_wh(cell.chargeable_ah(config), charger_a, config));
    let target_soc = fullest.soc.mean + (config.target_soc - pack.soc) * pack.capacity_ah / fullest.capacity.mean;
    let target_ah = |cell: &CellNow<'_>| ((target_soc - cell.soc.mean) * cell.capacity.mean).max(0.0);
    let charging = |charge_ah: &dyn Fn(&CellNow<'_>) -> f64| {
        let time_s = fullest.spread(|cell| cell.charging_s(charge_ah(cell), charger_a, config));
        let held_s = time_s.mean - 3600.0 * charge_ah(fullest) / charger_a;
        let variance = time_s.variance + square(LOG_HELD_STD * held_s);
        charger.map(|_| ScalarGaussian { variance, ..time_s })
    };
    let powers = |direction| {
        let [short, middle, long] = POWER_S.map(|for_s| {
            let limits = cells.iter().map(|cell| cell.limit_a(direction, for_s, config)).enumerate();
            let (index, limit_a) = limits.min_by(|a, b| a.1.total_cmp(&b.1))?;
            let power_w = |cell: &CellNow<'_>, limit_a: f64| limit_a * cell.voltage_after(direction, limit_a, for_s);
            let one = cells[index].spread(|cell| power_w(cell, cell.limit_a(direction, for_s, config)));
            Some((whole(one, &|cell| power_w(cell, limit_a)), index))
        });
        let limiting = CellIndex(u16::try_from(middle?.1).unwrap_or(u16::MAX));
        Some(([short?.0, middle?.0, long?.0], limiting))
    };
    let (discharge, charge) = (powers(Direction::Discharge)?, powers(Direction::Charge)?);
    Some(Outlook {
        remaining_wh: whole(energy, &|cell| cell.delivered_wh(drawn_ah, &drawn, config)),
        to_full_wh: whole(to_full, &|cell| cell.taken_wh(taken_ah, charger_a, config)),
        to_empty_s,
        to_full_s: charging(&|cell| cell.chargeable_ah(config)),
        to_target_s: charging(&target_ah).filter(|_| target_ah(fullest) <= taken_ah),
        discharge_w: discharge.0,
        charge_w: charge.0,
        limiting_cells: [discharge.1, charge.1],
    })
}

/// Energy of the full cell relative to a new cell of the rated capacity, both discharged at C/2 and 25 degrees C.
pub fn energy_health(config: &OutlookConfig, cell: &CellNow<'_>) -> ScalarGaussian {
    let load = Load::constant(USUAL_LOAD_PER_H * cell.model.rated_capacity_ah);
    let exact = |mean: f64| ScalarGaussian { mean, variance: 0.0 };
    let energy_wh = |cell: &CellNow<'_>| {
        let full = CellNow { soc: exact(1.0), ..*cell };
        full.delivered_wh(full.dischargeable_ah(&load, config), &load, config)
    };
    let (model, cell) = (cell.model, &CellNow { temperature: cell.model.temperature_position(CURVE_C), ..*cell });
    let new = CellNow { capacity: exact(model.capacity_ah), resistance_ratio: 1.0, slow_ratio: 1.0, ..*cell };
    let new_wh = energy_wh(&new) * model.rated_capacity_ah / model.capacity_ah;
    let aged = CellNow { soc: exact(1.0), ..*cell }.spread(energy_wh);
    ScalarGaussian { mean: aged.mean / new_wh, variance: aged.variance / square(new_wh) }
}

#[cfg(test)]
mod tests;
