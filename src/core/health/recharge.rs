//! Recharge period: duration of a charge between two SOC values, the *window*, raw and normalised (section 3.3.5 of the
//! paper that packwatch follows).
//!
//! In: the estimated SOC with its time, the mode, the learned capacity (Ah). Out: periods (s). If the estimated SOC
//! jumps, the caller discards the charge that is being timed.
//!
//! Raw: the time that the estimated SOC takes through the window, if one uninterrupted charge covers the whole window.
//! The raw period becomes shorter with a stronger charger, but also with a faded cell.
//!
//! Normalised: the time that a reference charger would need for the same window of the same pack:
//! `t = 3600 (to - from) C / I_ref`.
//! C is the pack's capacity (Ah), learned up to the end of this charge; I_ref is the reference current per cell (A).
//! The standard deviation of t is the standard deviation of C times the same factor. The standard deviation of C
//! includes the gain error of the current sensor, so that of t does, too.
//!
//! The formula uses C and not the charge moved within the window. Reason: the filter changes the estimated SOC by the
//! charge divided by the assumed capacity. The charge moved within the window is therefore the width of the window
//! times the assumed capacity, corrected only by the voltages within the window. C uses these voltages and all earlier
//! voltages, weighted by their information. Over the fleet of `tests/recharge_fleet.rs`, the RMS error is 0.57 % with C
//! and 0.78 % with the charge moved. C also has a standard deviation, and does not require a charge that covers the
//! whole window.
//!
//! Assumed: the reference charger holds its current over the whole window, so resistance, temperature and tapering have
//! no effect. C is the capacity between the open-circuit voltages of the full and the empty cell at the model's
//! reference temperature, whatever the temperature during the charge. The charge that a cold or worn cell accepts
//! within a charger's voltage limit is a different quantity.
//!
//! Deviation 1: the paper's script counts from the first charging sample, at any SOC. Here, a raw period requires one
//! uninterrupted charge over the whole window. Reason: the periods are then comparable.
//! Deviation 2: the paper has no normalised period. Here, a normalised period is reported once, at the end of a charge
//! that covered enough of the window ([`RechargeConfig::min_coverage`]). Reason: a short charge adds no information.

use serde::{Deserialize, Serialize};

use super::RechargeConfig;
use crate::filter::ScalarGaussian;
use crate::quantity::bounds;
use crate::quantity::{InvalidState, Mode, Timestamp};

/// Measures the time that the pack's SOC takes through the window during a charge.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct RechargeTimer {
    last: Option<(Timestamp, f64)>,
    entered: Option<Timestamp>,
    /// Lowest and highest SOC during the present charge.
    range: Option<(f64, f64)>,
    /// Raw period of the present charge (s).
    raw_s: Option<f64>,
}

/// Outcome of a finished charge.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ChargeRecord {
    /// Charging time over the whole window (s); `None` if no uninterrupted charge covered the window.
    pub raw_s: Option<f64>,
    /// Part of the window that the charge covered, 0 to 1.
    pub coverage: f64,
}

impl RechargeTimer {
    /// Handles the SOC at `time`. Returns the raw period (s) when the charge has just passed the window's upper end.
    pub fn observe(&mut self, config: &RechargeConfig, time: Timestamp, mode: Mode, soc: f64) -> Option<f64> {
        if mode != Mode::Charge {
            self.interrupt();
            return None;
        }
        self.range = Some(self.range.map_or((soc, soc), |(low, high)| (low.min(soc), high.max(soc))));
        let last = self.last.replace((time, soc))?;
        if let Some(at) = rising_crossing(last, (time, soc), config.from_soc) {
            self.entered = Some(at);
        }
        let left = rising_crossing(last, (time, soc), config.to_soc)?;
        let period_s = self.entered.take().map(|entered| left.since(entered))?;
        self.raw_s = Some(period_s);
        Some(period_s)
    }

    /// Stops timing the window. Keeps the raw period and the SOC range of the present charge.
    pub fn interrupt(&mut self) {
        (self.last, self.entered) = (None, None);
    }

    /// Handles a changed window: discards the raw period of the old window and keeps the SOC range.
    pub fn change_window(&mut self) {
        self.interrupt();
        self.raw_s = None;
    }

    /// Ends the charge; returns its outcome.
    pub fn finish(&mut self, config: &RechargeConfig) -> ChargeRecord {
        let charge = std::mem::take(self);
        let inside = |soc: f64| soc.clamp(config.from_soc, config.to_soc);
        let covered = charge.range.map_or(0.0, |(low, high)| inside(high) - inside(low));
        ChargeRecord { raw_s: charge.raw_s, coverage: covered / (config.to_soc - config.from_soc) }
    }

    /// Checks the numbers of a stored state.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        let (low, high) = self.range.unwrap_or_default();
        let socs = [self.last.map_or(0.0, |(_, soc)| soc), low, high];
        bounds::STORED_SOC.check_all("a SOC of the current charge", socs)?;
        bounds::TIME_S.check_all("the time of the current charge", self.raw_s)
    }

    /// Shifts all timestamps by `by_nanos`, to another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        self.last = self.last.map(|(time, soc)| (time.plus_nanos(by_nanos), soc));
        self.entered = self.entered.map(|time| time.plus_nanos(by_nanos));
    }
}

/// Time (s) that the reference current needs to charge a pack of `capacity` (Ah) through the window.
pub fn normalised_period(config: &RechargeConfig, capacity: ScalarGaussian) -> ScalarGaussian {
    let seconds_per_ah = 3600.0 * (config.to_soc - config.from_soc) / config.reference_current_a;
    ScalarGaussian {
        mean: seconds_per_ah * capacity.mean,
        variance: seconds_per_ah * seconds_per_ah * capacity.variance,
    }
}

/// Time at which a straight line from `a` to `b` rises through `level`.
fn rising_crossing(a: (Timestamp, f64), b: (Timestamp, f64), level: f64) -> Option<Timestamp> {
    (a.1 < level && b.1 >= level).then(|| a.0.plus_secs(b.0.since(a.0) * (level - a.1) / (b.1 - a.1)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::RechargeAlarm;

    const CONFIG: RechargeConfig = RechargeConfig {
        from_soc: 0.3,
        to_soc: 0.9,
        reference_current_a: 1.2,
        min_coverage: 0.5,
        alarm_on: RechargeAlarm::Raw,
    };

    /// Charges at 1 % per minute from SOC `from` to `to`, observed every 7 s. Returns the first raw period (s) and the
    /// outcome of the charge.
    fn charge(from: f64, to: f64, mode_at: impl Fn(f64) -> Mode) -> (Option<f64>, ChargeRecord) {
        let mut timer = RechargeTimer::default();
        let mut period_s = None;
        for k in 0..=((to - from) * 6000.0 / 7.0) as u32 {
            let t = f64::from(k) * 7.0;
            let now = timer.observe(&CONFIG, Timestamp::from_secs(t), mode_at(t), from + t / 6000.0);
            period_s = period_s.or(now);
        }
        (period_s, timer.finish(&CONFIG))
    }

    #[test]
    fn full_window_charge_is_timed_between_samples() {
        let (period_s, charged) = charge(0.1, 1.0, |_| Mode::Charge);
        assert!((period_s.expect("the charge covers the window") - 3600.0).abs() < 1e-6);
        assert_eq!(charged, ChargeRecord { raw_s: period_s, coverage: 1.0 });
    }

    #[test]
    fn charge_starting_inside_window_has_only_coverage() {
        let (period_s, charged) = charge(0.45, 1.0, |_| Mode::Charge);
        assert_eq!((period_s, charged.raw_s), (None, None));
        assert!((charged.coverage - 0.75).abs() < 1e-9);
    }

    #[test]
    fn interrupted_charge_has_no_raw_period() {
        let (period_s, _) = charge(0.1, 1.0, |t| if (2000.0..2020.0).contains(&t) { Mode::Rest } else { Mode::Charge });
        assert_eq!(period_s, None);
    }

    #[test]
    fn charge_outside_window_covers_nothing() {
        assert_eq!(charge(0.92, 1.0, |_| Mode::Charge).1, ChargeRecord::default());
        assert_eq!(RechargeTimer::default().finish(&CONFIG), ChargeRecord::default());
    }

    #[test]
    fn soc_jump_through_window_is_not_a_charge() {
        let mut timer = RechargeTimer::default();
        for (t, soc) in [(0.0, 0.2), (1.0, 0.31)] {
            timer.observe(&CONFIG, Timestamp::from_secs(t), Mode::Charge, soc);
        }
        timer = RechargeTimer::default();
        assert_eq!(timer.observe(&CONFIG, Timestamp::from_secs(2.0), Mode::Charge, 0.95), None);
        assert_eq!(timer.finish(&CONFIG), ChargeRecord::default());
    }

    #[test]
    fn finished_charge_resets_the_timer() {
        let mut timer = RechargeTimer::default();
        for (t, soc) in [(0.0, 0.2), (1.0, 0.4), (2.0, 0.95)] {
            timer.observe(&CONFIG, Timestamp::from_secs(t), Mode::Charge, soc);
        }
        assert!(timer.finish(&CONFIG).raw_s.is_some());
        assert_eq!(timer.finish(&CONFIG), ChargeRecord::default());
    }

    #[test]
    fn normalised_period_is_window_charge_over_reference_current() {
        // 60 % of 2 Ah at 1.2 A: one hour, with 1 % uncertainty.
        let period = normalised_period(&CONFIG, ScalarGaussian::from_std(2.0, 0.02));
        assert!((period.mean - 3600.0).abs() < 1e-9 && (period.std() - 36.0).abs() < 1e-9);
    }
}
