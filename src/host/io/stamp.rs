//! Parses and formats points in time as users and tables write them: seconds, or ISO 8601 dates in UTC.

use crate::quantity::Timestamp;

/// Parses decimal seconds (`12.5`, `-3`, `1e3`). A number without an exponent keeps every digit, up to ten digits
/// before and nine digits after the point. Returns `None` if the text is not a finite number.
pub fn parse_seconds(text: &[u8]) -> Option<Timestamp> {
    let text = text.trim_ascii();
    parse_exact(text).or_else(|| {
        let value: f64 = std::str::from_utf8(text).ok()?.parse().ok()?;
        value.is_finite().then(|| Timestamp::from_secs(value))
    })
}

/// Parses a number without rounding. `None` if it has more than ten digits before or nine digits after the point, or
/// another form.
fn parse_exact(text: &[u8]) -> Option<Timestamp> {
    let (negative, digits) = match text.strip_prefix(b"-") {
        Some(rest) => (true, rest),
        None => (false, text),
    };
    let point = digits.iter().position(|&b| b == b'.').unwrap_or(digits.len());
    let fraction = digits.get(point + 1..).unwrap_or_default();
    if digits.is_empty() || point > 9 + 1 || fraction.len() > 9 || (point == 0 && fraction.is_empty()) {
        return None;
    }
    let mut nanos: i64 = 0;
    let padding = 9 - fraction.len();
    for &byte in digits[..point].iter().chain(fraction) {
        let digit = byte.checked_sub(b'0').filter(|&d| d < 10)?;
        nanos = nanos.checked_mul(10)?.checked_add(i64::from(digit))?;
    }
    nanos = nanos.checked_mul(10i64.pow(padding as u32))?;
    Some(Timestamp::from_nanos(if negative { -nanos } else { nanos }))
}

/// Parses seconds, or a date such as `2008-04-02T13:08:17.921` in UTC. A space instead of the T, a final Z and missing
/// seconds are allowed.
pub fn parse_stamp(text: &str) -> Option<Timestamp> {
    let text = text.trim();
    match text.split_once(['T', ' ']) {
        Some((date, time)) => parse_iso(date, time.strip_suffix('Z').unwrap_or(time)),
        None => parse_seconds(text.as_bytes()),
    }
}

/// Parses a date with a time of day as programs write them: ISO 8601 with or without an offset from UTC,
/// `11/14/2023 10:13:20 PM`, `14.11.2023 22:13:20` or `14-Nov-23 22:13:20`. Without an offset the time is UTC.
/// `is_day_first` decides between day and month of `03/04/2023`.
pub fn parse_date(text: &str, is_day_first: bool) -> Option<Timestamp> {
    let text = text.trim();
    let (date, time) = text.split_once(' ').or_else(|| text.split_once('T'))?;
    let (year, month, day) = parse_day(date, is_day_first)?;
    let time = time.trim().replace(',', ".").to_ascii_uppercase();
    let (time, half_day) = match (time.strip_suffix("AM"), time.strip_suffix("PM")) {
        (Some(rest), _) => (rest.trim(), Some(0)),
        (_, Some(rest)) => (rest.trim(), Some(12)),
        _ => (time.as_str(), None),
    };
    let (time, offset_s) = split_offset(time)?;
    let stamp = parse_iso(&format!("{year:04}-{month:02}-{day:02}"), time)?;
    let hour = stamp.nanos().div_euclid(3_600_000_000_000).rem_euclid(24);
    let shift_h = match half_day {
        Some(half) if (1..=12).contains(&hour) => half - if hour == 12 { 12 } else { 0 },
        Some(_) => return None,
        None => 0,
    };
    Some(stamp.plus_nanos((shift_h * 3600 - offset_s) * 1_000_000_000))
}

/// Splits the offset from UTC off a time of day; returns seconds.
fn split_offset(time: &str) -> Option<(&str, i64)> {
    let time = time.strip_suffix('Z').unwrap_or(time);
    let Some(start) = time.rfind(['+', '-']) else { return Some((time, 0)) };
    let digits = time[start + 1..].replace(':', "");
    let minutes = match digits.len() {
        2 => 0,
        4 => number(digits.get(2..)?)?,
        _ => return None,
    };
    let hours = number(digits.get(..2)?)?;
    let seconds = hours * 3600 + minutes * 60;
    Some((time[..start].trim_end(), if time.as_bytes()[start] == b'-' { -seconds } else { seconds }))
}

fn parse_day(text: &str, is_day_first: bool) -> Option<(i64, i64, i64)> {
    const MONTHS: [&str; 12] = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"];
    let parts: Vec<&str> = text.split(['-', '/', '.']).collect();
    let [a, b, c] = parts[..] else { return None };
    if a.len() == 4 {
        return Some((number(a)?, number(b)?, number(c)?));
    }
    let year = number(c)? + if c.len() <= 2 { 2000 } else { 0 };
    if let Some(month) = MONTHS.iter().position(|month| b.to_ascii_lowercase().starts_with(month)) {
        return Some((year, month as i64 + 1, number(a)?));
    }
    let (a, b) = (number(a)?, number(b)?);
    Some(if is_day_first || text.contains('.') { (year, b, a) } else { (year, a, b) })
}

/// Parses a duration or time of day: `h:mm:ss`, `m:ss.f`, or with days in front: `1d 02:03:04.5`, `1-02:03:04`.
pub fn parse_clock(text: &str) -> Option<Timestamp> {
    let text = text.trim();
    let (days, time) = match text.split_once(['d', 'D']).or_else(|| text.split_once('-').filter(|of| !of.0.is_empty()))
    {
        Some((days, time)) => (number(days.trim())?, time.trim()),
        None => (0, text),
    };
    let (is_negative, time) = time.strip_prefix('-').map_or((false, time), |rest| (true, rest));
    let mut parts: Vec<&str> = time.split(':').collect();
    let seconds = parse_exact(parts.pop()?.replace(',', ".").as_bytes())?;
    let (hours, minutes) = match parts[..] {
        [hours, minutes] => (number(hours)?, number(minutes)?),
        [minutes] if time.contains(['.', ',']) => (0, number(minutes)?),
        _ => return None,
    };
    let whole = ((days * 24 + hours) * 60 + minutes).checked_mul(60_000_000_000)?;
    let nanos = seconds.plus_nanos(whole).nanos();
    Some(Timestamp::from_nanos(if is_negative { -nanos } else { nanos }))
}

fn parse_iso(date: &str, time: &str) -> Option<Timestamp> {
    let mut parts = date.splitn(3, '-').map(number);
    let (year, month, day) = (parts.next()??, parts.next()??, parts.next()??);
    let mut parts = time.splitn(3, ':');
    let (hour, minute) = (number(parts.next()?)?, number(parts.next()?)?);
    let seconds = parts.next().map_or(Some(Timestamp::ZERO), |s| parse_exact(s.as_bytes()))?;
    let days = days_from_epoch(year, month, day);
    let is_date = (1..=9999).contains(&year) && date_of(days) == (year, month, day);
    if !is_date || hour > 23 || minute > 59 || !(0..61_000_000_000).contains(&seconds.nanos()) {
        return None;
    }
    let whole = days * 86_400 + hour * 3600 + minute * 60;
    Some(seconds.plus_nanos(whole.checked_mul(1_000_000_000)?))
}

/// Parses a number of at most nine digits, so that later calculations cannot overflow.
fn number(text: &str) -> Option<i64> {
    (text.len() <= 9 && text.bytes().all(|b| b.is_ascii_digit())).then(|| text.parse().ok())?
}

/// Days since 1970-01-01 in the Gregorian calendar (years counted from March, in eras of 400 years). If the date does
/// not exist, the result is the number of another date.
fn days_from_epoch(year: i64, month: i64, day: i64) -> i64 {
    let shifted = if month <= 2 { year - 1 } else { year };
    let (era, of_era) = (shifted.div_euclid(400), shifted.rem_euclid(400));
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468
}

/// Formats a point in time in UTC, to the second: `2008-04-02T13:08:17Z`.
pub fn format_utc(time: Timestamp) -> String {
    let seconds = time.nanos().div_euclid(1_000_000_000);
    let (days, of_day) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let (year, month, day) = date_of(days);
    let (hour, minute, second) = (of_day / 3600, of_day / 60 % 60, of_day % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// Like [`format_utc`], to the microsecond: `2008-04-02T13:08:17.921000Z`.
pub fn format_utc_micros(time: Timestamp) -> String {
    let whole = format_utc(time);
    let micros = time.nanos().rem_euclid(1_000_000_000) / 1000;
    format!("{}.{micros:06}Z", whole.trim_end_matches('Z'))
}

/// Year, month and day of a number of days since 1970-01-01; inverse of `days_from_epoch`.
fn date_of(days: i64) -> (i64, i64, i64) {
    let days = days + 719_468;
    let (era, of_era) = (days.div_euclid(146_097), days.rem_euclid(146_097));
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * of_year + 2) / 153;
    let day = of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 { shifted_month + 3 } else { shifted_month - 9 };
    let year = era * 400 + year_of_era + i64::from(month <= 2);
    (year, month, day)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formatted_dates_parse_to_same_time() {
        for days in (-100_000..100_000).step_by(17).chain([-1, 0, 11_016, 11_017]) {
            let time = Timestamp::from_nanos((days * 86_400 + 47_297) * 1_000_000_000);
            let text = format_utc(time);
            assert_eq!(parse_stamp(&text), Some(time), "{text}");
        }
        assert_eq!(format_utc(Timestamp::from_secs(1_207_141_697.921)), "2008-04-02T13:08:17Z");
    }

    #[test]
    fn seconds_keep_every_digit() {
        let nanos = |text: &str| parse_seconds(text.as_bytes()).map(Timestamp::nanos);
        assert_eq!(nanos("1700000000.123456789"), Some(1_700_000_000_123_456_789));
        assert_eq!(nanos("-0.5"), Some(-500_000_000));
        assert_eq!(nanos(" 7597.875 "), Some(7_597_875_000_000));
        assert_eq!(nanos("1e3"), Some(1_000_000_000_000));
        assert_eq!(nanos(".5"), Some(500_000_000));
        for bad in ["", "-", ".", "nan", "inf", "1.2.3", "12a", "--1"] {
            assert_eq!(nanos(bad), None, "{bad}");
        }
    }

    #[test]
    fn dates_of_programs_are_read() {
        let expected = Some(1_700_000_000_000);
        for (text, is_day_first) in [
            ("2023-11-14T22:13:20Z", false),
            ("2023-11-14 22:13:20.000", false),
            ("2023-11-14T23:13:20+01:00", false),
            ("2023/11/14 22:13:20", false),
            ("11/14/2023 22:13:20", false),
            ("14/11/2023 22:13:20", true),
            ("11/14/2023 10:13:20 PM", false),
            ("14.11.2023 22:13:20", false),
            ("14-Nov-23 10:13:20 PM", false),
        ] {
            let found = parse_date(text, is_day_first).map(|time| time.nanos() / 1_000_000);
            assert_eq!(found, expected, "{text}");
        }
        let hour = |text: &str| parse_date(text, false).map(|time| time.nanos() / 3_600_000_000_000 % 24);
        assert_eq!((hour("11/14/2023 12:00:00 AM"), hour("11/14/2023 12:00:00 PM")), (Some(0), Some(12)));
        let long_offset = "2023-11-14T22:13:20+01999999999";
        for bad in [long_offset, "14/11/2023 22:13:20", "2023-11-14", "11/14/2023 13:00:00 PM", "a b", "1/2/3/4 5:6:7"]
        {
            assert_eq!(parse_date(bad, false), None, "{bad}");
        }
    }

    #[test]
    fn any_text_of_a_time_is_read_or_refused() {
        proptest::proptest!(|(text in "[0-9:dT .,+/-]{0,30}|.{0,20}", is_day_first: bool)| {
            let _ = (parse_date(&text, is_day_first), parse_clock(&text), parse_stamp(&text));
            let _ = parse_date(&format!("2023-11-14 {text}"), is_day_first);
        });
    }

    #[test]
    fn durations_with_colons_are_read() {
        for (text, expected_ms) in [
            ("00:00:01.500", Some(1500)),
            ("100:00:01", Some(360_001_000)),
            ("1d 02:03:04.5", Some(93_784_500)),
            ("1-02:03:04", Some(93_784_000)),
            ("0d 00:00:01,25", Some(1250)),
            ("01:02.5", Some(62_500)),
            ("01:02", None),
            ("x:00:01", None),
            ("1:2:3:4", None),
        ] {
            assert_eq!(parse_clock(text).map(|time| time.nanos() / 1_000_000), expected_ms, "{text}");
        }
    }

    #[test]
    fn iso_stamps_are_utc() {
        // The expected values are from `date -u -d ... +%s`.
        let secs = |text: &str| parse_stamp(text).map(|t| t.nanos() / 1_000_000);
        assert_eq!(secs("2008-04-02T13:08:17.921"), Some(1_207_141_697_921));
        assert_eq!(secs("1970-01-01 00:00"), Some(0));
        assert_eq!(secs("2000-02-29T23:59:59Z"), Some(951_868_799_000));
        assert_eq!(secs("1969-12-31T23:59:59"), Some(-1000));
        for bad in ["2001-02-29T00:00:00", "2008-13-01T00:00:00", "2008-04-02T24:00:00", "2008-04-02T1:2:x", "T"] {
            assert_eq!(secs(bad), None, "{bad}");
        }
    }
}
