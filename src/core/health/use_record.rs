//! Counts how a pack is used, for warranty and resale: time beyond its limits, C-rates, depth of discharge, fast
//! charges, and rest at a high state of charge.
//!
//! In: a [`UseSample`] every 0.1 s, and the half-cycles. Out: a [`UseRecord`] of fixed size, whose counts only increase
//! until the pack is replaced. Currents are per cell. Units: A (positive = discharge), degrees C, s.
//!
//! * Time counts only while the program receives ticks. A step of time longer than [`LONGEST_S`] is a gap. A gap can
//!   count only as rest at a high SOC. For this, its length must be known, the pack must have rested before it, and the
//!   SOC must be the same after it.
//! * If a value is unknown or doubtful, the time counts as unknown, neither as inside nor as beyond the limits. If only
//!   some sensors are known, a known value beyond its limit still counts as beyond.
//! * If a limit is not configured, no time counts as known for this limit.

use serde::{Deserialize, Serialize};

use super::HalfCycle;
use crate::quantity::{InvalidState, Mode, Timestamp};
use crate::sample::SensorRange;

/// Longest time between two ticks that counts as observed (s). A running program sends ticks more often.
const LONGEST_S: f64 = 5.0;
/// To count as an event, a value must be beyond a limit for this time (s) plus the longest time for which a single
/// reading is valid. A single wrong reading is therefore not an event.
const EVENT_S: f64 = 1.0;
/// An event ends after this time within the limit (s), so that a value at the limit is one event, not many.
const WITHIN_S: f64 = 10.0;
/// Distance by which a cell voltage must exceed its limit (V). A charger holds the highest voltage for an hour, and
/// sensors are wrong by 10 to 20 mV.
const VOLTAGE_MARGIN_V: f64 = 0.02;
/// Largest difference between the SOC before and after a gap in which the pack rested.
const SAME_SOC: f64 = 0.05;
/// A charge is fast if its mean C-rate is above this value. Chargers on alternating current stay below it.
const FAST_CHARGE_C: f64 = 1.0;
/// Upper edges of the C-rate bins, without the last bin (1/h).
pub const C_RATE_EDGES: [f64; 4] = [0.5, 1.0, 2.0, 3.0];

/// Time and events beyond one limit.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct LimitUse {
    /// Time in which a limit was configured and it was known whether the value was beyond the limit (s).
    pub known_s: f64,
    /// Part of the known time in which the value was beyond the limit (s).
    pub beyond_s: f64,
    /// Part of the time beyond the limit in which the pack was charged (s).
    pub beyond_charging_s: f64,
    /// Number of events. An event begins when the value has been beyond the limit for 1 s plus the longest time for
    /// which a single reading is valid. It ends after 10 s within the limit.
    pub events: u64,
}

/// Use of a value that has a lower and an upper limit.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct RangeUse {
    pub below: LimitUse,
    pub above: LimitUse,
    /// Time in which the value of at least one sensor was unknown or doubtful (s).
    pub unknown_s: f64,
    /// Lowest value, even of a single reading; `None` = no value yet.
    pub lowest: Option<f64>,
    /// Highest value, even of a single reading; `None` = no value yet.
    pub highest: Option<f64>,
}

/// Time by C-rate: up to 0.5, 1, 2 and 3 C, and above 3 C (s).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct CRateUse {
    /// Time with a current within the dead band of `[transition]` (s).
    pub rest_s: f64,
    /// Time of charging currents (s).
    pub charge_s: [f64; 5],
    /// Time of discharging currents (s).
    pub discharge_s: [f64; 5],
}

/// Half-cycles by kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct HalfCycleUse {
    /// Number of discharges by depth, in tenths of the rated capacity. The last number includes deeper discharges.
    pub discharges: [u64; 10],
    pub charges: u64,
    /// Number of charges with a mean C-rate above 1 C.
    pub fast_charges: u64,
    /// Number of half-cycles with a doubtful current, which the other numbers do not include.
    pub unknown: u64,
}

/// Rest at a high SOC.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct RestUse {
    /// Time at rest with a known SOC (s).
    pub known_s: f64,
    /// Part of the known time with a SOC above 80 % (s).
    pub above_80_s: f64,
    /// Part of the known time with a SOC above 90 % (s).
    pub above_90_s: f64,
    /// Time with an unknown current, and time at rest with a SOC that was unknown or not trusted (s).
    pub unknown_s: f64,
}

/// Counters of how a pack was used since the program first ran with it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct UseRecord {
    /// Temperatures of the sensors (degrees C).
    pub temperature_c: RangeUse,
    /// Voltages of the cells (V).
    pub voltage_v: RangeUse,
    /// Current per cell (A), positive = discharge. `below` counts charging currents beyond their limit, `above` counts
    /// discharging currents beyond their limit.
    pub current_a: RangeUse,
    /// Time by C-rate (current relative to the rated capacity).
    pub c_rate: CRateUse,
    pub half_cycles: HalfCycleUse,
    pub rest: RestUse,
}

/// A record with the state of its open events and of its latest gap.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UseCounter {
    record: UseRecord,
    latest: Option<Timestamp>,
    temperature: [Excursion; 2],
    voltage: [Excursion; 2],
    current: [Excursion; 2],
    /// Latest known SOC of the resting pack; `None` after a load.
    rest_soc: Option<f64>,
    /// Length of the gaps since this SOC was known (s).
    gap_s: f64,
}

/// Time beyond a limit since the last event ended, and time within the limit since the value was last beyond it (s).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Excursion {
    beyond_s: f64,
    within_s: f64,
}

/// Lower and upper limits; `None` = no limit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct UseLimits {
    pub temperature_c: [Option<f64>; 2],
    pub voltage_v: [Option<f64>; 2],
    /// Current per cell (A), positive = discharge.
    pub current_a: [Option<f64>; 2],
    /// Longest time for which a single temperature, voltage and current are valid (s).
    pub max_age_s: [f64; 3],
    /// Largest current of a resting cell (A).
    pub rest_a: f64,
    /// Rated capacity of a cell (Ah).
    pub rated_ah: f64,
}

/// A step of time, and the shortest time beyond a limit that is an event (s).
#[derive(Debug, Clone, Copy)]
struct Step {
    step_s: f64,
    event_s: f64,
    is_charging: bool,
}

/// Values of the pack at one time; `None` = unknown or doubtful.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct UseSample {
    pub temperature_c: Option<SensorRange>,
    pub voltage_v: Option<SensorRange>,
    /// Current per cell (A), positive = discharge.
    pub current_a: Option<f64>,
    /// SOC of the pack, fraction.
    pub soc: Option<f64>,
    pub is_charging: bool,
}

impl UseCounter {
    /// The record so far.
    pub fn record(&self) -> &UseRecord {
        &self.record
    }

    /// Counts the time since the previous sample with the values at `now`.
    pub fn observe(&mut self, now: Timestamp, limits: &UseLimits, sample: &UseSample) {
        let step_s = self.latest.replace(now).map_or(0.0, |before| now.since(before));
        if step_s > LONGEST_S {
            self.gap_s += step_s;
        }
        if !(0.0..=LONGEST_S).contains(&step_s) {
            return;
        }
        let record = &mut self.record;
        let [temperature_s, voltage_s, current_s] = limits.max_age_s.map(|max_age_s| Step {
            step_s,
            event_s: EVENT_S + max_age_s,
            is_charging: sample.is_charging,
        });
        record.temperature_c.observe(temperature_s, sample.temperature_c, limits.temperature_c, &mut self.temperature);
        let [low_v, high_v] = limits.voltage_v;
        let voltage_v = [low_v.map(|low_v| low_v - VOLTAGE_MARGIN_V), high_v.map(|high_v| high_v + VOLTAGE_MARGIN_V)];
        record.voltage_v.observe(voltage_s, sample.voltage_v, voltage_v, &mut self.voltage);
        let current = sample.current_a.map(SensorRange::of);
        record.current_a.observe(current_s, current, limits.current_a, &mut self.current);
        if let Some(current_a) = sample.current_a {
            record.c_rate.observe(step_s, current_a, limits);
        }
        self.observe_rest(step_s, sample.current_a.map(|current_a| current_a.abs() <= limits.rest_a), sample.soc);
    }

    /// Counts the time at rest. `is_rest`: `None` = unknown.
    fn observe_rest(&mut self, step_s: f64, is_rest: Option<bool>, soc: Option<f64>) {
        let rest = &mut self.record.rest;
        match (is_rest, soc) {
            (Some(false), _) => (self.rest_soc, self.gap_s) = (None, 0.0),
            (Some(true), Some(soc)) => {
                let (before, gap_s) = (self.rest_soc.replace(soc), std::mem::take(&mut self.gap_s));
                if let Some(before) = before.filter(|before| (before - soc).abs() <= SAME_SOC) {
                    rest.add(gap_s, soc.min(before));
                }
                rest.add(step_s, soc);
            }
            _ => rest.unknown_s += step_s,
        }
    }

    /// Counts the half-cycle that has ended. `cells`: half-cycle and rated capacity (Ah) of each cell whose current is
    /// not doubtful. The cell with the deepest half-cycle counts.
    pub fn count_half_cycle<'a>(&mut self, cells: impl Iterator<Item = (&'a HalfCycle, f64)>) {
        let counts = &mut self.record.half_cycles;
        let of_cell = |(half, rated_ah): (&HalfCycle, f64)| {
            (half.mode, half.charge_ah / rated_ah, half.mean_current_a.abs() / rated_ah)
        };
        let deepest = cells.map(of_cell).max_by(|a, b| a.1.total_cmp(&b.1));
        let add = |count: &mut u64| *count = count.saturating_add(1);
        match deepest {
            None => add(&mut counts.unknown),
            Some((Mode::Charge, _, c_rate)) => {
                add(&mut counts.charges);
                if c_rate > FAST_CHARGE_C {
                    add(&mut counts.fast_charges);
                }
            }
            // The conversion saturates.
            Some((_, depth, _)) => add(&mut counts.discharges[((10.0 * depth) as usize).min(9)]),
        }
    }

    /// Begins a gap of unknown length.
    pub fn interrupt(&mut self) {
        *self = Self { record: self.record, ..Self::default() };
    }

    /// Checks that every stored number is possible.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        const WHAT: &str = "the record of use";
        let UseRecord { temperature_c, voltage_v, current_a, c_rate, rest, .. } = &self.record;
        for range in [temperature_c, voltage_v, current_a] {
            for LimitUse { known_s, beyond_s, beyond_charging_s, .. } in [range.below, range.above] {
                InvalidState::unless_naturals(WHAT, [known_s, beyond_s, beyond_charging_s])?;
            }
            InvalidState::unless_natural(WHAT, range.unknown_s)?;
            InvalidState::unless_numbers(WHAT, range.lowest.into_iter().chain(range.highest))?;
        }
        InvalidState::unless_naturals(WHAT, c_rate.charge_s.into_iter().chain(c_rate.discharge_s))?;
        let RestUse { known_s, above_80_s, above_90_s, unknown_s } = *rest;
        InvalidState::unless_naturals(WHAT, [known_s, above_80_s, above_90_s, unknown_s, c_rate.rest_s, self.gap_s])?;
        for Excursion { beyond_s, within_s } in self.temperature.into_iter().chain(self.voltage).chain(self.current) {
            InvalidState::unless_naturals(WHAT, [beyond_s, within_s])?;
        }
        InvalidState::unless_numbers(WHAT, self.rest_soc)
    }

    /// Shifts the time by `by_nanos`, to another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        self.latest = self.latest.map(|latest| latest.plus_nanos(by_nanos));
    }
}

impl UseRecord {
    /// Number of events beyond any limit.
    pub fn events(&self) -> u64 {
        let sides = [self.temperature_c, self.voltage_v, self.current_a].map(|it| [it.below.events, it.above.events]);
        sides.into_iter().flatten().fold(0, u64::saturating_add)
    }

    /// Observed time in which it was not known whether a value was beyond `limit`, or no limit was configured (s).
    pub fn unknown_s(&self, limit: &LimitUse) -> f64 {
        let CRateUse { rest_s, charge_s, discharge_s } = self.c_rate;
        let moving_s: f64 = charge_s.iter().chain(&discharge_s).sum();
        (rest_s + moving_s + self.current_a.unknown_s - limit.known_s).max(0.0)
    }
}

impl RangeUse {
    fn observe(
        &mut self,
        step: Step,
        range: Option<SensorRange>,
        [low, high]: [Option<f64>; 2],
        [below, above]: &mut [Excursion; 2],
    ) {
        self.unknown_s += if range.is_some_and(|range| range.is_whole) { 0.0 } else { step.step_s };
        let Some(SensorRange { lowest, highest, is_whole }) = range else { return };
        self.lowest = Some(self.lowest.map_or(lowest, |before| before.min(lowest)));
        self.highest = Some(self.highest.map_or(highest, |before| before.max(highest)));
        for (limit, excursion, is_beyond) in [
            (&mut self.below, below, low.map(|low| lowest < low)),
            (&mut self.above, above, high.map(|high| highest > high)),
        ] {
            // If a sensor is unknown, the known values cannot show that all values are within the limit.
            if let Some(is_beyond) = is_beyond.filter(|is_beyond| *is_beyond || is_whole) {
                limit.add(step, is_beyond, excursion);
            }
        }
    }
}

impl LimitUse {
    fn add(&mut self, step: Step, is_beyond: bool, excursion: &mut Excursion) {
        let Step { step_s, event_s, is_charging } = step;
        self.known_s += step_s;
        if !is_beyond {
            excursion.within_s += step_s;
            if excursion.within_s >= WITHIN_S {
                *excursion = Excursion::default();
            }
            return;
        }
        self.beyond_s += step_s;
        self.beyond_charging_s += if is_charging { step_s } else { 0.0 };
        let before_s = excursion.beyond_s;
        *excursion = Excursion { beyond_s: before_s + step_s, within_s: 0.0 };
        if before_s < event_s && excursion.beyond_s >= event_s {
            self.events = self.events.saturating_add(1);
        }
    }
}

impl CRateUse {
    fn observe(&mut self, step_s: f64, current_a: f64, limits: &UseLimits) {
        if current_a.abs() <= limits.rest_a {
            self.rest_s += step_s;
            return;
        }
        let c_rate = current_a.abs() / limits.rated_ah;
        let bins = if current_a > 0.0 { &mut self.discharge_s } else { &mut self.charge_s };
        bins[C_RATE_EDGES.iter().filter(|edge| c_rate > **edge).count()] += step_s;
    }
}

impl RestUse {
    fn add(&mut self, step_s: f64, soc: f64) {
        self.known_s += step_s;
        self.above_80_s += if soc > 0.8 { step_s } else { 0.0 };
        self.above_90_s += if soc > 0.9 { step_s } else { 0.0 };
    }
}

#[cfg(test)]
mod tests;
