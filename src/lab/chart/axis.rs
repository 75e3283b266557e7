//! Determines the range, ticks and labels of an axis.

use crate::filter::ends;
use crate::io::stamp::format_utc;
use crate::quantity::Timestamp;

const MINUTE: f64 = 60.0;
const HOUR: f64 = 3600.0;
const DAY: f64 = 86_400.0;
/// Steps of a date axis below a month: unit (s) and the allowed multiples of the unit.
const STEPS: [(f64, &[f64]); 4] = [
    (1.0, &[1.0, 5.0, 15.0, 30.0]),
    (MINUTE, &[1.0, 5.0, 15.0, 30.0]),
    (HOUR, &[1.0, 2.0, 3.0, 4.0, 6.0, 12.0]),
    (DAY, &[1.0, 2.0, 5.0, 10.0, 20.0]),
];
const MONTH_S: f64 = 30.44 * DAY;

/// Scale of an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Scale {
    #[default]
    Number,
    /// Seconds since 1970, written as dates (UTC).
    Date,
}

/// One axis.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Axis {
    /// Label with unit.
    pub label: String,
    pub scale: Scale,
    /// Ends of the axis; `None` = the data determine them.
    pub range: Option<(f64, f64)>,
}

impl<T: Into<String>> From<T> for Axis {
    fn from(label: T) -> Self {
        Self { label: label.into(), ..Self::default() }
    }
}

impl Axis {
    /// Creates an axis of numbers whose range comes from the data.
    pub fn number(label: &str) -> Self {
        label.into()
    }

    pub fn within(self, low: f64, high: f64) -> Self {
        Self { range: Some((low, high)), ..self }
    }

    /// Returns the ends of the axis for these values; they always differ. If `margin` is set, both ends get additional
    /// room.
    pub(super) fn ends(&self, values: impl Iterator<Item = f64>, margin: bool) -> (f64, f64) {
        if let Some(range) = self.range {
            return widened(range, 0.0);
        }
        let ends = ends(values.filter(|value| value.is_finite()));
        // Room at each end, as a share of the range of the data.
        widened(ends, if margin { 0.06 } else { 0.0 })
    }

    pub(super) fn ticks(&self, ends: (f64, f64), count: f64) -> Vec<(f64, String)> {
        match self.scale {
            Scale::Number => number_ticks(ends, count),
            Scale::Date => date_ticks(ends, count),
        }
    }

    /// Returns the label of the axis. For dates, it includes the days at both ends, because the ticks may be hours.
    pub(super) fn caption(&self, ends: (f64, f64)) -> String {
        match self.scale {
            Scale::Number => self.label.clone(),
            Scale::Date => format!("{}, {} to {}", self.label, day(ends.0), day(ends.1)),
        }
    }
}

fn widened((low, high): (f64, f64), margin: f64) -> (f64, f64) {
    if low > high {
        return (0.0, 1.0);
    }
    let width = high - low;
    // A range that is too narrow for distinct ticks gets room around the value.
    let room = if width <= 1e-9 * low.abs().max(1e-3) { 0.5 * low.abs().clamp(1.0, 3600.0) } else { margin * width };
    (low - room, high + room)
}

fn number_ticks((low, high): (f64, f64), count: f64) -> Vec<(f64, String)> {
    let raw = (high - low) / count.max(1.0);
    let power = 10.0_f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().find(|m| m * power >= raw).unwrap_or(10.0) * power;
    let decimals = (-step.log10().floor()).max(0.0) as usize;
    let first = (low / step).ceil();
    // With this step, there are at most `count` + 1 ticks.
    (0..=count.ceil() as usize)
        .map(|index| (first + index as f64) * step)
        .take_while(|value| *value <= high + 1e-9 * step)
        // This avoids "-0".
        .map(|value| if value.abs() < 1e-9 * step { 0.0 } else { value })
        .map(|value| (value, format!("{value:.decimals$}").replace('-', "\u{2212}")))
        .collect()
}

fn date_ticks((low, high): (f64, f64), count: f64) -> Vec<(f64, String)> {
    let raw = (high - low) / count.max(1.0);
    let mut steps = STEPS.iter().flat_map(|(unit, counts)| counts.iter().map(move |count| count * unit));
    match steps.find(|step| *step >= raw) {
        Some(step) => {
            let first = (low / step).ceil();
            (0..=count.ceil() as usize)
                .map(|index| (first + index as f64) * step)
                .take_while(|time| *time <= high)
                .map(|time| (time, moment(time, step)))
                .collect()
        }
        None => month_ticks((low, high), raw),
    }
}

fn month_ticks((low, high): (f64, f64), raw: f64) -> Vec<(f64, String)> {
    // Steps in months.
    let step = [1, 2, 3, 6, 12, 24, 60].into_iter().find(|step| *step as f64 * MONTH_S >= raw);
    let step = step.unwrap_or_else(|| 12 * ((raw / (12.0 * MONTH_S)).ceil() as i64));
    let text = format_utc(Timestamp::from_secs(low));
    let part = |range: std::ops::Range<usize>| text.get(range).and_then(|digits| digits.parse::<i64>().ok());
    let (Some(year), Some(month)) = (part(0..4), part(5..7)) else { return Vec::new() };
    let begin = (year * 12 + month - 1).div_euclid(step) * step;
    let at = |months: i64| {
        let date = format!("{:04}-{:02}-01T00:00", months.div_euclid(12), months.rem_euclid(12) + 1);
        let time_s = crate::io::stamp::parse_stamp(&date)?.secs();
        Some((time_s, if step % 12 == 0 { date[..4].to_owned() } else { date[..7].to_owned() }))
    };
    (0..100)
        .map_while(|index| at(begin + index * step))
        .skip_while(|tick| tick.0 < low)
        .take_while(|tick| tick.0 <= high)
        .collect()
}

/// Formats a time with the precision of the step. At midnight, the date replaces the time.
fn moment(time_s: f64, step: f64) -> String {
    let text = format_utc(Timestamp::from_secs(time_s));
    let part = if step >= DAY || (step >= MINUTE && time_s.rem_euclid(DAY) == 0.0) {
        5..10
    } else if step >= MINUTE {
        11..16
    } else {
        11..19
    };
    text.get(part).unwrap_or_default().to_owned()
}

pub(super) fn day(time_s: f64) -> String {
    format_utc(Timestamp::from_secs(time_s)).get(..10).unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(ticks: &[(f64, String)]) -> Vec<&str> {
        ticks.iter().map(|(_, word)| word.as_str()).collect()
    }

    #[test]
    fn ticks_are_round_with_the_needed_digits() {
        let axis = Axis::number("Ah");
        assert_eq!(words(&axis.ticks((1.31, 1.92), 4.0)), ["1.4", "1.6", "1.8"]);
        assert_eq!(words(&axis.ticks((-0.2, 0.2), 4.0)), ["\u{2212}0.2", "\u{2212}0.1", "0.0", "0.1", "0.2"]);
        assert_eq!(words(&axis.ticks((0.0, 40_000.0), 4.0)), ["0", "10000", "20000", "30000", "40000"]);
    }

    #[test]
    fn dates_fall_on_hours_days_and_months() {
        let axis = Axis { scale: Scale::Date, ..Axis::number("time") };
        let start = 1_207_141_697.0; // 2008-04-02T13:08:17Z
        assert_eq!(words(&axis.ticks((start, start + 6.0 * HOUR), 6.0))[..2], ["14:00", "15:00"]);
        assert_eq!(words(&axis.ticks((start, start + 40.0), 4.0)), ["13:08:30", "13:08:45"]);
        assert_eq!(words(&axis.ticks((start, start + 50.0 * DAY), 5.0))[0], "04-11");
        assert_eq!(words(&axis.ticks((start, start + 2.0 * DAY), 5.0)), ["04-03", "12:00", "04-04", "12:00"]);
        assert_eq!(words(&axis.ticks((start, start + 400.0 * DAY), 5.0)), ["2008-07", "2008-10", "2009-01", "2009-04"]);
        assert_eq!(words(&axis.ticks((start, start + 4000.0 * DAY), 6.0))[..2], ["2010", "2012"]);
    }

    #[test]
    fn empty_and_constant_data_give_an_axis() {
        let axis = Axis::number("");
        assert_eq!(axis.ends([f64::NAN].into_iter(), true), (0.0, 1.0));
        let (low, high) = axis.ends([4.0].into_iter(), true);
        assert!(low < 4.0 && high > 4.0);
    }
}
