//! Records a pack's use: current, counted charge, the median cell's voltage and the values that the pack itself
//! reports, all at the same times.
//!
//! In: readings with their times. Out: at most [`MAX_MOMENTS`] moments, evenly spread over the log. Charge is counted
//! from one moment to the next (Ah, positive = discharge), so thinning loses no charge. A gap begins a new stretch,
//! because the charge that flowed in the gap is unknown. Each reading of the current is assumed to hold until the
//! next reading.

use crate::filter::{ends, median};
use crate::quantity::Timestamp;

const MAX_MOMENTS: usize = 1024;
/// Maximum time for which a current reading holds (s). A longer gap begins a new stretch.
const MAX_HOLD_S: f64 = 40.0;
/// Time constant of the smoothed current (s). The slow part of a cell's overvoltage follows the smoothed current.
const SETTLE_S: f64 = 300.0;
/// Maximum difference between the reported state of charge and the cells' state of charge. A vehicle hides a reserve
/// at both ends, and the controller's estimate has an error.
pub const HIDDEN_SOC: f64 = 0.13;
/// Maximum steady current of a pack (A). A larger value contains an offset.
pub const STEADY_A: f64 = 1000.0;
pub(crate) const MAX_REPORTED: usize = 8;

/// State of the pack at one time, in the units of the configuration.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moment {
    pub(crate) time: Timestamp,
    /// Number of the stretch; only charges of one stretch are comparable.
    pub(crate) stretch: u32,
    /// Charge counted since the first reading (Ah), positive = discharge.
    pub(crate) charge_ah: f64,
    pub(crate) current_a: f64,
    pub(crate) slow_a: f64,
    pub(crate) voltage_v: f64,
    /// Latest reported values; NaN = not received yet.
    pub(crate) reported: [f64; MAX_REPORTED],
}

#[derive(Debug, Clone)]
pub(crate) struct UsageRecord {
    moments: Vec<Moment>,
    /// Minimum time between two moments (s). Doubles if there are too many moments.
    every_s: f64,
    current: Option<(Timestamp, f64)>,
    slow_a: f64,
    charge_ah: f64,
    stretch: u32,
    cells_v: Vec<f64>,
    reported: [f64; MAX_REPORTED],
}

impl UsageRecord {
    pub(crate) fn new(cells: usize) -> Self {
        Self {
            moments: Vec::new(),
            every_s: 1.0,
            current: None,
            slow_a: 0.0,
            charge_ah: 0.0,
            stretch: 0,
            cells_v: vec![f64::NAN; cells],
            reported: [f64::NAN; MAX_REPORTED],
        }
    }

    pub(crate) fn handle_current(&mut self, time: Timestamp, current_a: f64) {
        match self.current {
            Some((last, held_a)) if (0.0..=MAX_HOLD_S).contains(&time.since(last)) => {
                let passed_s = time.since(last);
                self.charge_ah += held_a * passed_s / 3600.0;
                self.slow_a += (held_a - self.slow_a) * -(-passed_s / SETTLE_S).exp_m1();
            }
            // Because of jitter between two buses, a reading may be stamped slightly before the previous one. Ignore
            // it.
            Some((last, _)) if time < last && last.since(time) < 1.0 => return,
            _ => {
                self.stretch += 1;
                self.slow_a = current_a;
            }
        }
        self.current = Some((time, current_a));
    }

    pub(crate) fn handle_reported(&mut self, place: usize, value: f64) {
        if let Some(slot) = self.reported.get_mut(place) {
            *slot = value;
        }
    }

    pub(crate) fn handle_voltage(&mut self, time: Timestamp, cell: usize, voltage_v: f64) {
        if let Some(slot) = self.cells_v.get_mut(cell) {
            *slot = voltage_v;
        }
        let is_due = self.moments.last().is_none_or(|last| time.since(last.time) >= self.every_s);
        let fresh = self.current.filter(|(at, _)| time.since(*at) <= MAX_HOLD_S);
        let (true, Some((_, current_a))) = (is_due, fresh) else { return };
        let Some(voltage_v) = median(self.cells_v.iter().copied().filter(|v| v.is_finite())) else { return };
        let Self { stretch, charge_ah, slow_a, reported, .. } = *self;
        self.moments.push(Moment { time, stretch, charge_ah, current_a, slow_a, voltage_v, reported });
        if self.moments.len() >= MAX_MOMENTS {
            let mut index = 0;
            self.moments.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.every_s *= 2.0;
        }
    }

    /// Ends the stretch, because the observer did not listen or no frames were sent.
    pub(crate) fn pause(&mut self) {
        self.current = None;
        self.cells_v.fill(f64::NAN);
        self.reported.fill(f64::NAN);
    }

    pub(crate) fn moments(&self) -> &[Moment] {
        &self.moments
    }
}

/// Charge per reported state of charge, fitted over all stretches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ChargeSlope {
    /// Charge (Ah) drawn while the reported state of charge falls from 1 to 0; negative if the reported state of charge
    /// rises during a discharge.
    pub(crate) capacity_ah: f64,
    /// Share of the variance that a common slope of all stretches explains, 0 to 1.
    pub(crate) r2: f64,
    /// Range of the reported value, within one stretch.
    pub(crate) range: f64,
    /// Largest rise and largest fall of the reported value, within one stretch.
    pub(crate) rise: f64,
    pub(crate) fall: f64,
    /// Number of different reported values, within one stretch.
    pub(crate) distinct: usize,
    /// Range of the charge, within one stretch (Ah).
    pub(crate) charge_range_ah: f64,
}

/// Pairs of charge (Ah) and reported state of charge, for each stretch. Where the pack's controller corrects the
/// reported value, the value jumps much further than the charge, and the stretch is split.
fn stretches(moments: &[Moment], place: usize) -> Vec<Vec<(f64, f64)>> {
    /// Maximum number of corrections. If there are more jumps, they are the steps of a value that is sent rarely, and
    /// the stretch is not split.
    const MOST: usize = 3;
    let points = |stretch: &[Moment]| -> Vec<(f64, f64)> {
        let all = stretch.iter().map(|moment| (moment.charge_ah, moment.reported[place]));
        all.filter(|(_, soc)| soc.is_finite()).collect()
    };
    let split = |points: Vec<(f64, f64)>| {
        let range = |value: fn(&(f64, f64)) -> f64| {
            let (low, high) = ends(points.iter().map(value));
            (high - low).max(1e-9)
        };
        let (charge_ah, soc) = (range(|point| point.0), range(|point| point.1));
        let goes_on = |a: &(f64, f64), b: &(f64, f64)| {
            let change = (b.1 - a.1).abs();
            // A change of less than three steps of 1 % is not a correction.
            change < 0.03 || change / soc < 10.0 * (b.0 - a.0).abs() / charge_ah
        };
        let parts: Vec<Vec<(f64, f64)>> = points.chunk_by(goes_on).map(<[_]>::to_vec).collect();
        if parts.len() > MOST + 1 { vec![points] } else { parts }
    };
    moments.chunk_by(|a, b| a.stretch == b.stretch).flat_map(|stretch| split(points(stretch))).collect()
}

impl ChargeSlope {
    /// Fits the charge against the reported value `place`; `None` without values.
    pub(crate) fn of(moments: &[Moment], place: usize) -> Option<Self> {
        let (mut qq, mut qs, mut ss) = (0.0, 0.0, 0.0);
        let (mut range, mut distinct, mut charge_range_ah) = (0.0_f64, 0, 0.0_f64);
        let (mut rise, mut fall) = (0.0_f64, 0.0_f64);
        for points in stretches(moments, place) {
            let n = points.len() as f64;
            let (sum_q, sum_s) = points.iter().fold((0.0, 0.0), |(q, s), point| (q + point.0, s + point.1));
            for (q, s) in &points {
                let (q, s) = (q - sum_q / n, s - sum_s / n);
                (qq, qs, ss) = (qq + q * q, qs + q * s, ss + s * s);
            }
            let extent = |values: &mut dyn Iterator<Item = f64>| {
                let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
                (high - low).max(0.0)
            };
            range = range.max(extent(&mut points.iter().map(|point| point.1)));
            charge_range_ah = charge_range_ah.max(extent(&mut points.iter().map(|point| point.0)));
            let (mut lowest, mut highest) = (f64::MAX, f64::MIN);
            for (_, s) in &points {
                (lowest, highest) = (lowest.min(*s), highest.max(*s));
                (rise, fall) = (rise.max(s - lowest), fall.max(highest - s));
            }
            let mut values: Vec<u64> = points.iter().map(|point| point.1.to_bits()).collect();
            values.sort_unstable();
            values.dedup();
            distinct = distinct.max(values.len());
        }
        if distinct == 0 {
            return None;
        }
        let (capacity_ah, r2) = if ss > 0.0 && qq > 0.0 { (-qs / ss, qs * qs / (qq * ss)) } else { (f64::NAN, 0.0) };
        Some(Self { capacity_ah, r2, range, rise, fall, distinct, charge_range_ah })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;

    #[test]
    fn reported_charge_gives_capacity_across_gaps() {
        let mut record = UsageRecord::new(1);
        let mut soc: f64 = 0.9;
        for second in 0..40_000_u32 {
            let time = Timestamp::from_secs(f64::from(second));
            let current_a = if (second / 3000).is_multiple_of(3) { -20.0 } else { 30.0 };
            if (20_000..24_000).contains(&second) {
                record.pause();
                soc = 0.4;
                continue;
            }
            soc -= current_a / 3600.0 / 150.0;
            record.handle_reported(0, f64::round(soc * 200.0) / 200.0);
            record.handle_current(time, current_a);
            record.handle_voltage(time, 0, 3.7);
        }
        assert!(record.moments().len() <= MAX_MOMENTS && record.moments().len() > MAX_MOMENTS / 3);
        let slope = ChargeSlope::of(record.moments(), 0).unwrap();
        assert!((slope.capacity_ah - 150.0).abs() < 5.0 && slope.r2 > 0.98, "{slope:?}");
        assert!(ChargeSlope::of(record.moments(), 1).is_none());
    }
}
