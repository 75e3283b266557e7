//! Parses the times of a table: numbers in a unit, durations with colons, or dates.

use crate::io::stamp;
use crate::io::units::Unit;
use crate::quantity::Timestamp;

const DAY_NS: i64 = 86_400_000_000_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TimeForm {
    Number,
    /// A duration or time of day with colons.
    Clock,
    Date,
}

#[derive(Debug, Clone)]
pub(super) struct TimeText {
    pub(super) unit: &'static Unit,
    pub(super) is_day_first: bool,
    /// Whether a time of day that is earlier than the time before it belongs to the next day.
    pub(super) wraps: bool,
    last_clock: Option<i64>,
    days: i64,
}

impl TimeText {
    pub(super) fn new(unit: &'static Unit) -> Self {
        Self { unit, is_day_first: false, wraps: true, last_clock: None, days: 0 }
    }

    pub(super) fn form(text: &str) -> TimeForm {
        let text = text.trim();
        let Some(colon) = text.find(':') else { return TimeForm::Number };
        let before = &text[..colon];
        let is_date = before.contains([' ', 'T']) && before.contains(['-', '/', '.']);
        if is_date { TimeForm::Date } else { TimeForm::Clock }
    }

    /// Whether dates begin with the day (and not with the month), and whether this is a guess. If one order can read
    /// more of the dates than the other, it is right. If both orders can read the same number, the order that gives the
    /// shorter record is taken as a guess.
    pub(super) fn is_day_first(texts: &[impl AsRef<str>]) -> (bool, bool) {
        let read = |text: &str| [true, false].map(|is_day_first| stamp::parse_date(text, is_day_first));
        let dates: Vec<[Option<Timestamp>; 2]> =
            texts.iter().map(|text| read(text.as_ref().trim().trim_matches('"'))).collect();
        let [day, month] = [0, 1].map(|order| dates.iter().filter(|of| of[order].is_some()).count());
        if day != month || dates.iter().all(|of| of[0] == of[1]) {
            return (day > month, false);
        }
        let [day, month] = [0, 1].map(|order| {
            let times = || dates.iter().filter_map(|of| of[order]).map(Timestamp::nanos);
            times().max().zip(times().min()).map(|(last, first)| last.saturating_sub(first))
        });
        (day < month, true)
    }

    /// Parses a time; `None` if the text is not a time.
    pub(super) fn parse(&mut self, field: &[u8]) -> Option<Timestamp> {
        let field = field.strip_prefix(b"\"").and_then(|field| field.strip_suffix(b"\"")).unwrap_or(field);
        let is_seconds = self.unit.nanos() == Some(1_000_000_000);
        if let Some(time) = is_seconds.then(|| stamp::parse_seconds(field)).flatten() {
            return is_representable(time).then_some(time);
        }
        let text = std::str::from_utf8(field).ok()?;
        match Self::form(text) {
            TimeForm::Number => self.number(&text.trim().replace(',', ".")),
            TimeForm::Clock => self.clock(text),
            TimeForm::Date => stamp::parse_date(text, self.is_day_first),
        }
    }

    fn number(&self, text: &str) -> Option<Timestamp> {
        if let (Ok(count), Some(nanos)) = (text.parse::<i64>(), self.unit.nanos()) {
            return count.checked_mul(nanos).map(Timestamp::from_nanos).filter(|time| is_representable(*time));
        }
        let seconds = self.unit.convert(text.parse().ok()?);
        // Programs write times in minutes, hours or days with few digits. A sample after one minute would then not be
        // exactly at 60 s, so the result is rounded to 0.1 ms.
        let seconds = if self.unit.per_base() < 1.0 { (seconds * 1e4).round() / 1e4 } else { seconds };
        let time = seconds.is_finite().then(|| Timestamp::from_secs(seconds));
        time.filter(|time| is_representable(*time))
    }

    fn clock(&mut self, text: &str) -> Option<Timestamp> {
        let nanos = stamp::parse_clock(text)?.nanos();
        let begins_anew = |last: i64| last < DAY_NS && nanos < DAY_NS / 24 && last > DAY_NS - DAY_NS / 24;
        if self.wraps && self.last_clock.is_some_and(begins_anew) {
            self.days += 1;
        }
        self.last_clock = Some(nanos);
        let time = Timestamp::from_nanos(nanos).plus_nanos(self.days.saturating_mul(DAY_NS));
        is_representable(time).then_some(time)
    }
}

/// Whether a time lies within the representable range (1677 to 2262).
fn is_representable(time: Timestamp) -> bool {
    !matches!(time.nanos(), i64::MIN | i64::MAX) && time.nanos().abs() < i64::MAX - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Parses the texts as times in `unit`. Returns milliseconds.
    fn times(unit: &str, texts: &[&str]) -> Vec<Option<i64>> {
        let mut reader = TimeText::new(Unit::find(unit).expect("known"));
        texts.iter().map(|text| reader.parse(text.as_bytes()).map(|time| time.nanos() / 1_000_000)).collect()
    }

    #[test]
    fn numbers_are_in_their_unit() {
        assert_eq!(times("min", &["0.5", "1"]), [Some(30_000), Some(60_000)]);
        assert_eq!(times("ms", &["1700000000123"]), [Some(1_700_000_000_123)]);
        assert_eq!(times("s", &["1700000000123000"]), [None]);
        assert_eq!(times("Excel days", &["45244", "45244.5"]), [Some(1_699_920_000_000), Some(1_699_963_200_000)]);
        assert_eq!(times("s", &["\"0,5\"", "x", ""]), [Some(500), None, None]);
    }

    #[test]
    fn any_text_of_a_time_is_read_or_refused() {
        proptest::proptest!(|(text in proptest::collection::vec("[0-9:dT .,+/-]{0,24}|.{0,9}|23:59:59|0:0:0|2562047:47:16", 1..9))| {
            times("s", &text.iter().map(String::as_str).collect::<Vec<_>>());
            times("h", &text.iter().map(String::as_str).collect::<Vec<_>>());
        });
        assert_eq!(times("s", &["23:59:59", "2562047:47:16", "23:59:59", "0:00:00"])[3], Some(86_400_000));
    }

    #[test]
    fn time_of_day_continues_after_midnight() {
        assert_eq!(times("s", &["23:59:59", "00:00:00"]), [Some(86_399_000), Some(86_400_000)]);
        assert_eq!(times("s", &["0:59:59", "0:00:00"]), [Some(3_599_000), Some(0)]);
    }
}
