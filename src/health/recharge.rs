//! The recharge period: seconds a charge takes between two SOC values (paper, section 3.3.5).
//!
//! Deviation: the paper's script counts from the first charging sample, whatever the SOC then. Here a period is
//! recorded only when one uninterrupted charge covers the whole window, so that periods can be compared.

use serde::{Deserialize, Serialize};

use super::RechargeConfig;
use crate::quantity::{Mode, Timestamp};

/// Watches the pack's SOC during charges.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct RechargeTimer {
    last: Option<(Timestamp, f64)>,
    entered: Option<Timestamp>,
}

impl RechargeTimer {
    /// Takes the SOC at `time`; returns the seconds when the charge has just left the window at its top.
    pub fn observe(&mut self, config: &RechargeConfig, time: Timestamp, mode: Mode, soc: f64) -> Option<f64> {
        if mode != Mode::Charge {
            self.interrupt();
            return None;
        }
        let last = self.last.replace((time, soc))?;
        if let Some(at) = rising_crossing(last, (time, soc), config.from_soc) {
            self.entered = Some(at);
        }
        let left = rising_crossing(last, (time, soc), config.to_soc)?;
        self.entered.take().map(|entered| left.since(entered))
    }

    /// The charge was interrupted, or its time is not known.
    pub fn interrupt(&mut self) {
        (self.last, self.entered) = (None, None);
    }

    /// Moves stored stamps onto another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        self.last = self.last.map(|(time, soc)| (time.plus_nanos(by_nanos), soc));
        self.entered = self.entered.map(|time| time.plus_nanos(by_nanos));
    }
}

/// When the line between two points rises through `level`.
fn rising_crossing(a: (Timestamp, f64), b: (Timestamp, f64), level: f64) -> Option<Timestamp> {
    (a.1 < level && b.1 >= level).then(|| a.0.plus_secs(b.0.since(a.0) * (level - a.1) / (b.1 - a.1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: RechargeConfig = RechargeConfig { from_soc: 0.3, to_soc: 0.9 };

    fn charge(from: f64, mode_at: impl Fn(f64) -> Mode) -> Option<f64> {
        let mut timer = RechargeTimer::default();
        // 1 % a minute, seen every 7 s.
        (0..2000)
            .map(|k| f64::from(k) * 7.0)
            .find_map(|t| timer.observe(&CONFIG, Timestamp::from_secs(t), mode_at(t), from + t / 6000.0))
    }

    #[test]
    fn a_charge_that_covers_the_window_is_timed_between_samples() {
        let seconds = charge(0.1, |_| Mode::Charge).expect("covers it");
        assert!((seconds - 3600.0).abs() < 1e-6);
    }

    #[test]
    fn a_charge_that_starts_inside_the_window_is_not_recorded() {
        assert_eq!(charge(0.35, |_| Mode::Charge), None);
    }

    #[test]
    fn an_interrupted_charge_is_not_recorded() {
        assert_eq!(charge(0.1, |t| if (2000.0..2020.0).contains(&t) { Mode::Rest } else { Mode::Charge }), None);
    }
}
