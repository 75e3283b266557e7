//! Parses the dates that tools of many languages write: weekday, month name, day, time and year in any order, and
//! numeric dates.
//!
//! A date without a time zone is read as UTC, because logs do not state the zone of their local time.

const SECOND_NS: i64 = 1_000_000_000;
const MINUTE_S: i64 = 60;
const HOUR_S: i64 = 3600;
const DAY_S: i64 = 86_400;

/// Beginnings of month names in English, German, French, Italian, Spanish, Portuguese, Dutch, Swedish and Polish, in
/// lower case. `?` stands for a letter outside of ASCII, which logs contain in different encodings.
const MONTHS: [&[&str]; 12] = [
    &["jan", "gen", "ene", "sty"],
    &["feb", "f?v", "fev", "lut"],
    &["mar", "m?r", "mrt", "mrz"],
    &["apr", "avr", "abr", "kwi"],
    &["may", "mai", "maj", "mei", "mag"],
    &["jun", "juin", "giu", "cze"],
    &["jul", "juil", "lug", "lip"],
    &["aug", "ao?", "aou", "ago", "sie"],
    &["sep", "set", "wrz"],
    &["oct", "okt", "ott", "out", "pa?"],
    &["nov", "lis"],
    &["dec", "d?c", "dez", "des", "dic", "gru"],
];

/// Marks of the two halves of a day, in lower case. Chinese and Korean marks are UTF-8.
const BEFORE_NOON: [&str; 4] = ["am", "a.m.", "\u{4e0a}\u{5348}", "\u{c624}\u{c804}"];
const AFTER_NOON: [&str; 4] = ["pm", "p.m.", "\u{4e0b}\u{5348}", "\u{c624}\u{d6c4}"];

#[derive(Debug, Default)]
struct Parts {
    year: Option<i64>,
    month: Option<i64>,
    day: Option<i64>,
    /// Time since midnight, ns.
    time_ns: Option<i64>,
    /// Offset of the time zone from UTC, s.
    zone_s: i64,
    is_after_noon: Option<bool>,
}

/// Parses a date with a time. The result is in nanoseconds since 1970. `None` if the date is incomplete, does not exist,
/// or is before 1970 or after 2261.
pub(super) fn parse(text: &[u8]) -> Option<i64> {
    let mut parts = Parts::default();
    for word in text.split(|byte| matches!(byte, b' ' | b'\t' | b',')).filter(|word| !word.is_empty()) {
        parts.word(&word.to_ascii_lowercase());
    }
    let mut time_ns = parts.time_ns?;
    let noon_ns = 12 * HOUR_S * SECOND_NS;
    match parts.is_after_noon {
        Some(true) if time_ns < noon_ns => time_ns += noon_ns,
        Some(false) if time_ns >= noon_ns => time_ns -= noon_ns,
        _ => {}
    }
    let midnight_ns = midnight(parts.year?, parts.month?, parts.day?)?;
    midnight_ns.checked_add(time_ns)?.checked_sub(parts.zone_s * SECOND_NS)
}

/// Time of the start of a day, ns since 1970. `None` if the day does not exist or is out of range.
pub(crate) fn midnight(year: i64, month: i64, day: i64) -> Option<i64> {
    let is_leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let last = match month {
        4 | 6 | 9 | 11 => 30,
        2 => 28 + i64::from(is_leap),
        _ => 31,
    };
    if !(1970..=2261).contains(&year) || !(1..=12).contains(&month) || !(1..=last).contains(&day) {
        return None;
    }
    // Years are counted from March, so that the leap day is the last day of a year.
    let shifted = if month <= 2 { year - 1 } else { year };
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let days = shifted * 365 + shifted / 4 - shifted / 100 + shifted / 400 + of_year - 719_468;
    days.checked_mul(DAY_S * SECOND_NS)
}

impl Parts {
    /// Evaluates one word in lower case. Ignores words with another meaning, such as weekdays.
    fn word(&mut self, word: &[u8]) {
        let digits = word.iter().take_while(|byte| byte.is_ascii_digit()).count();
        if digits > 0 {
            self.numeric(word, digits);
        } else if BEFORE_NOON.iter().any(|mark| mark.as_bytes() == word) {
            self.is_after_noon = Some(false);
        } else if AFTER_NOON.iter().any(|mark| mark.as_bytes() == word) {
            self.is_after_noon = Some(true);
        } else if let Some(month) = (1..).zip(MONTHS).find(|(_, names)| names.iter().any(|name| begins(word, name))) {
            // The Italian weekday "mar" looks like the month March. A weekday comes before the month, so the month
            // replaces it.
            self.month = Some(month.0);
        }
    }

    fn numeric(&mut self, word: &[u8], digits: usize) {
        if let Some(date) = iso_date(word) {
            (self.year, self.month, self.day) = (Some(date.0), Some(date.1), Some(date.2));
            let separator = if digits == 8 { 8 } else { 10 };
            if let Some([b't', time @ ..]) = word.get(separator..) {
                self.clock(time);
            }
        } else if word.contains(&b':') {
            self.clock(word);
        } else if let Some((first, second, year)) = numeric_date(word) {
            // With dots, the day comes first. With slashes, the month comes first, unless the first number cannot be a
            // month.
            let is_day_first = word[digits] != b'/' || first > 12;
            let (day, month) = if is_day_first { (first, second) } else { (second, first) };
            (self.year, self.month, self.day) = (Some(year), Some(month), Some(day));
        } else {
            let value = integer(&word[..digits]);
            match digits {
                4 => self.year = value,
                _ if word[digits..].starts_with("\u{6708}".as_bytes()) => self.month = value,
                _ if word[digits..].starts_with("\u{c6d4}".as_bytes()) => self.month = value,
                _ if self.day.is_none() => self.day = value,
                _ => {}
            }
        }
    }

    /// Evaluates a time such as `22:13:20.123` or, without separators, `221320`. Further digits may follow another
    /// point or colon, and a zone `z` or `+01:00` may follow the time.
    fn clock(&mut self, word: &[u8]) {
        let zone_at = word.iter().position(|byte| matches!(byte, b'+' | b'-' | b'z')).unwrap_or(word.len());
        let (time, zone) = word.split_at(zone_at);
        self.time_ns = clock_ns(time);
        if let [sign @ (b'+' | b'-'), zone @ ..] = zone {
            let zone: Vec<u8> = zone.iter().copied().filter(u8::is_ascii_digit).collect();
            if let (Some(hours), Some(minutes)) = (zone.get(..2).and_then(integer), zone.get(2..4).and_then(integer)) {
                let offset_s = hours * HOUR_S + minutes * MINUTE_S;
                self.zone_s = if *sign == b'-' { -offset_s } else { offset_s };
            }
        }
    }
}

/// Parses a time of day: `22:13:20.123`, `22:13:20`, `12:52:32.484.3`, `221320` or `221320.5`, ns.
fn clock_ns(time: &[u8]) -> Option<i64> {
    let (fields, fraction) = match time.split_at_checked(6) {
        Some((digits, fraction)) if digits.iter().all(u8::is_ascii_digit) => (digits.chunks(2).collect(), fraction),
        _ => {
            let mut fields: Vec<&[u8]> = time.splitn(4, |byte| matches!(byte, b':' | b'.' | b',')).collect();
            let fraction = if fields.len() > 3 { fields.pop() } else { None };
            (fields, fraction.unwrap_or_default())
        }
    };
    let [hours, minutes, seconds] = [0, 1, 2].map(|n| fields.get(n).map_or(Some(0), |field| integer(field)));
    let (hours, minutes, seconds) = (hours?, minutes?, seconds?);
    let digits = fraction.iter().filter(|byte| byte.is_ascii_digit()).chain(std::iter::repeat(&b'0'));
    let fraction_ns = digits.take(9).fold(0, |ns, byte| ns * 10 + i64::from(byte - b'0'));
    let is_time = fields.len() >= 2 && hours < 24 && minutes < 60 && seconds <= 60;
    is_time.then_some((hours * HOUR_S + minutes * MINUTE_S + seconds) * SECOND_NS + fraction_ns)
}

/// Parses a date `2023-11-14`, `2023/11/14` or `20231114` at the start of a word.
fn iso_date(word: &[u8]) -> Option<(i64, i64, i64)> {
    let is_separated = matches!(word.get(4), Some(b'-' | b'/')) && word.get(7) == word.get(4);
    let (month, day) = if is_separated { (5..7, 8..10) } else { (4..6, 6..8) };
    Some((integer(word.get(..4)?)?, integer(word.get(month)?)?, integer(word.get(day)?)?))
}

/// Parses three numbers separated by `.`, `/` or `-`. The last number must have four digits.
fn numeric_date(word: &[u8]) -> Option<(i64, i64, i64)> {
    let mut fields = word.splitn(3, |byte| matches!(byte, b'.' | b'/' | b'-'));
    let (first, second, year) = (fields.next()?, fields.next()?, fields.next()?);
    Some((integer(first)?, integer(second)?, integer(year).filter(|_| year.len() == 4)?))
}

/// Parses at most nine digits.
pub(super) fn integer(digits: &[u8]) -> Option<i64> {
    let is_number = (1..=9).contains(&digits.len()) && digits.iter().all(u8::is_ascii_digit);
    is_number.then(|| digits.iter().fold(0, |value, byte| value * 10 + i64::from(byte - b'0')))
}

/// Whether a word begins with a name of [`MONTHS`].
fn begins(word: &[u8], name: &str) -> bool {
    // A letter outside of ASCII has one byte in Latin-1 and two bytes in UTF-8.
    let mut bytes = word.iter().peekable();
    name.bytes().all(|letter| match bytes.next() {
        Some(byte) if letter == b'?' => {
            let is_foreign = !byte.is_ascii() || *byte == b'?';
            while bytes.next_if(|byte| !byte.is_ascii()).is_some() {}
            is_foreign
        }
        found => found == Some(&letter),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_of_many_languages_give_the_same_time() {
        let dates = [
            "Tue Nov 14 22:13:20.500 2023",
            "Tue Nov 14 10:13:20.500 pm 2023",
            "Tue Nov 14 10:13:20.5 PM 2023",
            "Die Nov 14 22:13:20.500 2023",
            "mar. nov. 14 22:13:20.500 2023",
            "mar nov 14 10:13:20.500 PM 2023",
            "wto lis 14 22:13:20.500 2023",
            "\u{5468}\u{4e8c} 11\u{6708} 14 10:13:20.500 \u{4e0b}\u{5348} 2023",
            "Tue, 14 Nov 2023 22:13:20.500 GMT",
            "2023-11-14T22:13:20.500Z",
            "2023-11-14 23:13:20.500+01:00",
            "2023-11-14 22:13:20.500000",
            "20231114T221320.5",
            "14.11.2023 22:13:20.500",
            "14.11.2023 22:13:20.500.0",
            "11/14/2023 22:13:20.500",
            "14/11/2023 22:13:20:500",
        ];
        for date in dates {
            assert_eq!(parse(date.as_bytes()), Some(1_700_000_000_500_000_000), "{date}");
        }
        assert_eq!(parse(b"20231114T221320"), Some(1_700_000_000_000_000_000));
    }

    #[test]
    fn german_march_is_read_in_each_encoding() {
        let expected = parse(b"Mon Mar 4 12:00:00 2024");
        assert!(expected.is_some());
        for month in ["M\u{e4}r".as_bytes(), b"M\xE4r", b"M?r", b"Mrz"] {
            let date = [b"Mon ".as_slice(), month, b" 4 12:00:00.000 2024"].concat();
            assert_eq!(parse(&date), expected, "{date:?}");
        }
        assert_eq!(parse(b"Mon Mai 6 12:00:00.000 2024"), parse(b"Mon May 6 12:00:00 pm 2024"));
    }

    #[test]
    fn midnight_and_noon_follow_the_marks() {
        let at = |text: &str| parse(format!("Thu Jan 1 {text} 1970").as_bytes());
        assert_eq!(at("12:00:01 am"), Some(1_000_000_000));
        assert_eq!(at("12:00:01 pm"), Some((12 * 3600 + 1) * 1_000_000_000));
        assert_eq!(at("00:00:00"), Some(0));
    }

    #[test]
    fn dates_that_do_not_exist_are_refused() {
        let dates = [
            "Feb 30 12:00:00 2024",
            "Nov 14 25:00:00 2023",
            "Nov 14 2023",
            "12:00:00 2023",
            "PM 2021",
            "",
            "Jan 1 12:00:00 9999",
            "\u{661f}\u{671f}",
        ];
        for date in dates {
            assert_eq!(parse(date.as_bytes()), None, "{date}");
        }
    }
}
