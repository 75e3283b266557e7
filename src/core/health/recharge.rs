//! The recharge period: seconds a charge takes between two SOC values (paper, section 3.3.5), as it was and made
//! comparable.
//!
//! Raw: the time from one SOC to the other, both found by the estimate, when one uninterrupted charge covers the
//! whole window. It is as short for a strong charger as for a faded cell.
//!
//! Normalised: the time a reference charger would need for the same window of the same pack,
//! `t = 3600 (to - from) C / I_ref`, C = the pack's capacity (Ah) as learned up to the end of this charge, I_ref the
//! reference current per cell (A). Standard deviation: C's, scaled (so the gain error of the current sensor is in it).
//!
//! Why C, and not what this charge alone moved between the two SOC values: between the crossings the estimated SOC
//! moves by charge over the capacity assumed, so that charge is the window times the assumption, plus what the
//! voltages said against it meanwhile; C holds the same voltages and all earlier ones, weighed by their information.
//! Over the fleet of `tests/recharge_fleet.rs`, which prints them side by side, it is off by 0.57 % RMS and the charge's
//! own figure by 0.78 %; and it knows its standard deviation and needs no charge that covers the window.
//!
//! Assumed: the reference charger holds its current over the whole window, so neither resistance nor temperature
//! nor a tapering charger has a part in it. The capacity is that between the open-circuit ends at the reference
//! temperature, whatever the temperature of the charge: there is no reference temperature to configure. What a cold
//! or a worn cell takes within a charger's voltage limit is another question (`usable` answers it for discharges).
//!
//! Deviation 1: the paper's script counts from the first charging sample, whatever the SOC then. Here a raw period is
//! recorded only when one uninterrupted charge covers the whole window, so that periods can be compared.
//! Deviation 2: the normalised period, which the paper does not have. Told once per charge that covered enough of
//! the window ([`RechargeConfig::min_coverage`]), at its end: a short charge says nothing new.

use serde::{Deserialize, Serialize};

use super::RechargeConfig;
use crate::filter::ScalarGaussian;
use crate::quantity::{InvalidState, Mode, Timestamp};

/// Watches the pack's SOC during charges.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct RechargeTimer {
    last: Option<(Timestamp, f64)>,
    entered: Option<Timestamp>,
    /// Lowest and highest SOC of this charge.
    #[serde(default)]
    range: Option<(f64, f64)>,
    /// Raw period of this charge, s.
    #[serde(default)]
    raw_s: Option<f64>,
}

/// What a charge that is over says.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Charged {
    /// Seconds it took over the whole window; `None` = it did not cover it in one go.
    pub raw_s: Option<f64>,
    /// Part of the window it covered, 0 to 1.
    pub coverage: f64,
}

impl RechargeTimer {
    /// Takes the SOC at `time`; returns the seconds when the charge has just left the window at its top.
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

    /// Nobody watches from here on: what the charge has said so far stands.
    pub fn interrupt(&mut self) {
        (self.last, self.entered) = (None, None);
    }

    /// The SOC jumped, or its time is not known: nothing seen of this charge counts.
    pub fn discard(&mut self) {
        *self = Self::default();
    }

    /// The window is another one: what the charge has said of the old one does not count, how far it went does.
    pub fn change_window(&mut self) {
        self.interrupt();
        self.raw_s = None;
    }

    /// The charge is over.
    pub fn finish(&mut self, config: &RechargeConfig) -> Charged {
        let ended = std::mem::take(self);
        let inside = |soc: f64| soc.clamp(config.from_soc, config.to_soc);
        let covered = ended.range.map_or(0.0, |(low, high)| inside(high) - inside(low));
        Charged { raw_s: ended.raw_s, coverage: covered / (config.to_soc - config.from_soc) }
    }

    /// Whether the numbers of a stored one can be gone on with.
    ///
    /// # Errors
    /// The first that cannot.
    pub fn check(&self) -> Result<(), InvalidState> {
        let (low, high) = self.range.unwrap_or_default();
        let all = [self.last.map_or(0.0, |(_, soc)| soc), low, high, self.raw_s.unwrap_or(0.0)];
        all.into_iter().try_for_each(|x| InvalidState::unless_number("a SOC or time of the charge under way", x))
    }

    /// Moves stored stamps onto another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        self.last = self.last.map(|(time, soc)| (time.plus_nanos(by_nanos), soc));
        self.entered = self.entered.map(|time| time.plus_nanos(by_nanos));
    }
}

/// Seconds a charger that holds the reference current needs for the window of a pack of `capacity` (Ah).
pub fn normalised_period(config: &RechargeConfig, capacity: ScalarGaussian) -> ScalarGaussian {
    let seconds_per_ah = 3600.0 * (config.to_soc - config.from_soc) / config.reference_current_a;
    ScalarGaussian {
        mean: seconds_per_ah * capacity.mean,
        variance: seconds_per_ah * seconds_per_ah * capacity.variance,
    }
}

/// When the line between two points rises through `level`.
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

    /// 1 % a minute from `from` to `to`, seen every 7 s, then the charge's end.
    fn charge(from: f64, to: f64, mode_at: impl Fn(f64) -> Mode) -> (Option<f64>, Charged) {
        let mut timer = RechargeTimer::default();
        let mut told = None;
        for k in 0..=((to - from) * 6000.0 / 7.0) as u32 {
            let t = f64::from(k) * 7.0;
            let now = timer.observe(&CONFIG, Timestamp::from_secs(t), mode_at(t), from + t / 6000.0);
            told = told.or(now);
        }
        (told, timer.finish(&CONFIG))
    }

    #[test]
    fn a_charge_that_covers_the_window_is_timed_between_samples() {
        let (told, charged) = charge(0.1, 1.0, |_| Mode::Charge);
        assert!((told.expect("covers it") - 3600.0).abs() < 1e-6);
        assert_eq!(charged, Charged { raw_s: told, coverage: 1.0 });
    }

    #[test]
    fn a_charge_that_starts_inside_the_window_has_only_its_coverage() {
        let (told, charged) = charge(0.45, 1.0, |_| Mode::Charge);
        assert_eq!((told, charged.raw_s), (None, None));
        assert!((charged.coverage - 0.75).abs() < 1e-9);
    }

    #[test]
    fn an_interrupted_charge_has_no_raw_period() {
        let (told, _) = charge(0.1, 1.0, |t| if (2000.0..2020.0).contains(&t) { Mode::Rest } else { Mode::Charge });
        assert_eq!(told, None);
    }

    #[test]
    fn a_charge_outside_the_window_covers_nothing() {
        assert_eq!(charge(0.92, 1.0, |_| Mode::Charge).1, Charged::default());
        assert_eq!(RechargeTimer::default().finish(&CONFIG), Charged::default());
    }

    #[test]
    fn what_a_jump_of_the_soc_crossed_was_not_charged() {
        let mut timer = RechargeTimer::default();
        for (t, soc) in [(0.0, 0.2), (1.0, 0.31)] {
            timer.observe(&CONFIG, Timestamp::from_secs(t), Mode::Charge, soc);
        }
        timer.discard();
        assert_eq!(timer.observe(&CONFIG, Timestamp::from_secs(2.0), Mode::Charge, 0.95), None);
        assert_eq!(timer.finish(&CONFIG), Charged::default());
    }

    #[test]
    fn a_finished_charge_leaves_nothing_for_the_next() {
        let mut timer = RechargeTimer::default();
        for (t, soc) in [(0.0, 0.2), (1.0, 0.4), (2.0, 0.95)] {
            timer.observe(&CONFIG, Timestamp::from_secs(t), Mode::Charge, soc);
        }
        assert!(timer.finish(&CONFIG).raw_s.is_some());
        assert_eq!(timer.finish(&CONFIG), Charged::default());
    }

    #[test]
    fn the_normalised_period_is_the_windows_charge_over_the_reference_current() {
        // 60 % of 2 Ah at 1.2 A: one hour; 1 % of it uncertain.
        let period = normalised_period(&CONFIG, ScalarGaussian::from_std(2.0, 0.02));
        assert!((period.mean - 3600.0).abs() < 1e-9 && (period.std() - 36.0).abs() < 1e-9);
    }
}
