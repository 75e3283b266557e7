//! Defines the structure that a standard requires of a JSON document, and checks documents against it.
//!
//! Input: rows of a path and the kind of its content, for example the path `identification.codes[].key|value`. In a
//! path, `a|b` stands for two members `a` and `b` of the same kind, `[]` marks a list, and `{}` marks a list without
//! duplicates. If a member may be missing, the first row that names it marks it with `?`. A member that the standard
//! does not define is a fault, because a misspelt name would otherwise stay unnoticed.

use std::collections::HashSet;
use std::ops::Range;

use serde_json::{Map, Value};

/// Content of a leaf.
#[derive(Debug, Clone, Copy)]
pub(super) enum Kind {
    /// Any text.
    Text,
    /// A text that is not empty.
    Identifier,
    /// Any number.
    Number,
    /// A number in this range.
    Within(f64, f64),
    /// True or false.
    Flag,
    /// yyyy-mm-dd, a day of the calendar.
    Date,
    /// Date and time, with or without time zone.
    Time,
    /// A UUID, possibly as a URN.
    Uuid,
    /// A business partner number: the given letters, followed by twelve characters.
    Partner(&'static str),
    /// One of the given texts.
    Choice(&'static [&'static str]),
    /// One of the given texts, or `customKey:` followed by a word.
    LocalKey(&'static [&'static str]),
    /// A list of documents, each with content, contentType and header.
    Documents,
    /// A list of facilities. Each is a business partner number that starts with BPNA.
    Facilities,
    /// A measured value: value and time.
    Reading,
}

#[derive(Debug)]
pub(super) enum Shape {
    /// A leaf.
    Leaf(Kind),
    /// An object.
    Object(Vec<Member>),
    /// A list.
    List { is_set: bool, item: Box<Shape> },
}

#[derive(Debug)]
pub(super) struct Member {
    name: String,
    is_required: bool,
    shape: Shape,
}

#[derive(Debug, Default, PartialEq)]
pub(super) struct Verdict {
    pub(super) faults: Vec<String>,
    pub(super) missing: Vec<String>,
}

impl Shape {
    pub(super) fn of_rows(rows: &[(&str, Kind)]) -> Self {
        let mut root = Self::Object(Vec::new());
        for (path, kind) in rows {
            root.add(path, *kind);
        }
        root
    }

    /// Adds the leaves of a path below this object. A path with `|` has several leaves.
    fn add(&mut self, path: &str, kind: Kind) {
        let (steps, rest) = path.split_once('.').unwrap_or((path, ""));
        let Self::Object(members) = self else { return };
        for step in steps.split('|') {
            let name = step.trim_end_matches(['[', ']', '{', '}', '?']);
            let position = members.iter().position(|member| member.name == name).unwrap_or_else(|| {
                let inner = if rest.is_empty() { Self::of_kind(kind) } else { Self::Object(Vec::new()) };
                let shape = if step.ends_with(']') || step.ends_with('}') {
                    Self::List { is_set: step.ends_with('}'), item: Box::new(inner) }
                } else {
                    inner
                };
                members.push(Member { name: name.to_owned(), is_required: !step.contains('?'), shape });
                members.len() - 1
            });
            match &mut members[position].shape {
                _ if rest.is_empty() => {}
                Self::List { item, .. } => item.add(rest, kind),
                shape => shape.add(rest, kind),
            }
        }
    }

    fn of_kind(kind: Kind) -> Self {
        let list = |rows: &[(&str, Kind)]| Self::List { is_set: false, item: Box::new(Self::of_rows(rows)) };
        match kind {
            Kind::Documents => list(&[("content", Kind::Text), ("contentType", Kind::Text), ("header", Kind::Text)]),
            Kind::Facilities => list(&[("facility", Kind::Partner("BPNA"))]),
            Kind::Reading => Self::of_rows(&[("value", Kind::Number), ("time", Kind::Time)]),
            kind => Self::Leaf(kind),
        }
    }

    /// Returns a document to fill in. It contains the members that are not measured, with `null` for each value and one
    /// item in each list. `None` = every member is measured.
    pub(super) fn template(&self, path: &str, is_measured: &dyn Fn(&str) -> bool) -> Option<Value> {
        Some(match self {
            _ if is_measured(path) => return None,
            Self::Leaf(_) => Value::Null,
            Self::List { item, .. } => Value::Array(vec![item.template(path, is_measured)?]),
            Self::Object(members) => {
                let inner = members.iter().filter_map(|member| {
                    let value = member.shape.template(&joined(path, &member.name), is_measured)?;
                    Some((member.name.clone(), value))
                });
                let inner: Map<String, Value> = inner.collect();
                return (!inner.is_empty()).then_some(Value::Object(inner));
            }
        })
    }

    /// Checks a document. A missing object is reported as one missing member. If `is_opened` returns true for the path
    /// of the object, each of its required members is reported as missing instead.
    pub(super) fn check(&self, document: &Value, is_opened: &dyn Fn(&str) -> bool) -> Verdict {
        let mut verdict = Verdict::default();
        self.check_at("", document, is_opened, &mut verdict);
        verdict
    }

    fn check_at(&self, path: &str, value: &Value, is_opened: &dyn Fn(&str) -> bool, verdict: &mut Verdict) {
        match self {
            Self::Leaf(kind) => {
                if let Some(allowed) = kind.refuses(value) {
                    verdict.faults.push(format!("{path}: found {value}, must be {allowed}"));
                }
            }
            Self::Object(members) => match value.as_object() {
                Some(object) => check_object(path, members, object, is_opened, verdict),
                None => verdict.faults.push(format!("{}: found {}, must be an object", named(path), short(value))),
            },
            Self::List { is_set, item } => match value.as_array() {
                Some(list) => {
                    let mut seen = HashSet::new();
                    for (index, one) in list.iter().enumerate() {
                        item.check_at(&format!("{path}[{index}]"), one, is_opened, verdict);
                        if *is_set && !seen.insert(one) {
                            verdict.faults.push(format!("{path}[{index}]: found twice, must occur once"));
                        }
                    }
                }
                None => verdict.faults.push(format!("{path}: found {}, must be a list", short(value))),
            },
        }
    }
}

fn check_object(
    path: &str,
    members: &[Member],
    object: &Map<String, Value>,
    is_opened: &dyn Fn(&str) -> bool,
    verdict: &mut Verdict,
) {
    for member in members {
        let path = joined(path, &member.name);
        match (object.get(&member.name), &member.shape) {
            (Some(value), shape) => shape.check_at(&path, value, is_opened, verdict),
            (None, Shape::Object(members)) if member.is_required && is_opened(&path) => {
                check_object(&path, members, &Map::new(), is_opened, verdict);
            }
            (None, _) if member.is_required => verdict.missing.push(path),
            (None, _) => {}
        }
    }
    for name in object.keys().filter(|name| members.iter().all(|member| member.name != **name)) {
        let known: Vec<&str> = members.iter().map(|member| member.name.as_str()).collect();
        verdict.faults.push(format!("{}: not in the standard, which has {}", joined(path, name), known.join(", ")));
    }
}

pub(super) fn joined(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") }
}

fn named(path: &str) -> &str {
    if path.is_empty() { "the document" } else { path }
}

fn short(value: &Value) -> String {
    match value {
        Value::Object(_) => "an object".to_owned(),
        Value::Array(_) => "a list".to_owned(),
        other => other.to_string(),
    }
}

impl Kind {
    /// Returns the allowed values if the value is not allowed; `None` = it is allowed.
    fn refuses(self, value: &Value) -> Option<String> {
        let number = |is_good: &dyn Fn(f64) -> bool| value.as_f64().is_some_and(is_good);
        let text = |is_good: &dyn Fn(&str) -> bool| value.as_str().is_some_and(is_good);
        let (is_good, allowed) = match self {
            Self::Text => (value.is_string(), "a text".to_owned()),
            Self::Identifier => (text(&|text| !text.is_empty()), "a text that is not empty".to_owned()),
            Self::Number => (value.is_number(), "a number".to_owned()),
            Self::Within(low, high) => {
                let allowed = if high.is_finite() { format!("{low} to {high}") } else { format!("{low} or more") };
                (number(&|number| (low..=high).contains(&number)), allowed)
            }
            Self::Flag => (value.is_boolean(), "true or false".to_owned()),
            Self::Date => (text(&is_date), "a date like 2026-01-31".to_owned()),
            Self::Time => (text(&is_time), "a time like 2026-01-31T12:00:00Z".to_owned()),
            Self::Uuid => (text(&is_uuid), "a UUID, with or without urn:uuid: in front".to_owned()),
            Self::Partner(letters) => {
                (text(&|text| is_partner(text, letters)), format!("{letters} and twelve letters or digits"))
            }
            Self::Choice(all) => (text(&|text| all.contains(&text)), format!("one of {}", all.join(", "))),
            Self::LocalKey(all) => {
                let is_key = |text: &str| all.contains(&text) || text.strip_prefix("customKey:").is_some_and(is_word);
                (text(&is_key), format!("one of {}, customKey:WORD", all.join(", ")))
            }
            // [`Shape::of_kind`] makes lists and objects of these kinds, not leaves.
            Self::Documents | Self::Facilities | Self::Reading => (true, String::new()),
        };
        (!is_good).then_some(allowed)
    }
}

/// Whether a text matches a pattern. In the pattern `form`, `0` matches any digit; other characters match themselves.
fn has_form(text: &str, form: &str) -> bool {
    let fits = |(byte, expected): (u8, u8)| if expected == b'0' { byte.is_ascii_digit() } else { byte == expected };
    text.len() == form.len() && text.bytes().zip(form.bytes()).all(fits)
}

/// Whether the text is a calendar day, with a year of four digits.
fn is_date(text: &str) -> bool {
    if !has_form(text, "0000-00-00") {
        return false;
    }
    let (year, month, day) = (number_in(text, 0..4), number_in(text, 5..7), number_in(text, 8..10));
    let is_leap_year = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let days = match month {
        2 => 28 + u32::from(is_leap_year),
        4 | 6 | 9 | 11 => 30,
        1..=12 => 31,
        _ => 0,
    };
    (1..=days).contains(&day)
}

/// Whether a text is a date with a time. Seconds may have decimals. The zone is `Z`, an offset, or missing.
fn is_time(text: &str) -> bool {
    let Some((date, clock)) = text.split_once('T') else { return false };
    let zone_at = clock.find(['Z', '+', '-']).unwrap_or(clock.len());
    let (clock, zone) = clock.split_at(zone_at);
    let (whole, part) = clock.split_once('.').unwrap_or((clock, "0"));
    is_date(date)
        && has_form(whole, "00:00:00")
        && number_in(whole, 0..2) <= 23
        && number_in(whole, 3..5) <= 59
        && number_in(whole, 6..8) <= 59
        && !part.is_empty()
        && part.bytes().all(|byte| byte.is_ascii_digit())
        && is_zone(zone)
}

/// Whether the zone is empty, `Z`, or an offset of at most 14 hours, as in XML Schema.
fn is_zone(zone: &str) -> bool {
    let is_offset = |offset: &str| {
        let (hours, minutes) = (number_in(offset, 0..2), number_in(offset, 3..5));
        has_form(offset, "00:00") && minutes <= 59 && 60 * hours + minutes <= 14 * 60
    };
    matches!(zone, "" | "Z") || zone.strip_prefix(['+', '-']).is_some_and(is_offset)
}

fn number_in(text: &str, digits: Range<usize>) -> u32 {
    text.get(digits).and_then(|digits| digits.parse().ok()).unwrap_or(0)
}

fn is_uuid(text: &str) -> bool {
    let digits = text.strip_prefix("urn:uuid:").unwrap_or(text);
    let lengths = digits.split('-').map(str::len).collect::<Vec<_>>() == [8, 4, 4, 4, 12];
    lengths && digits.bytes().all(|byte| byte == b'-' || byte.is_ascii_hexdigit())
}

fn is_partner(text: &str, letters: &str) -> bool {
    let rest = text.strip_prefix(letters).unwrap_or_default();
    rest.len() == 12 && rest.bytes().all(|byte| byte.is_ascii_alphanumeric())
}

fn is_word(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_alphanumeric() || c == '_')
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn shape() -> Shape {
        Shape::of_rows(&[
            ("name", Kind::Identifier),
            ("size.width?", Kind::Within(0.0, 100.0)),
            ("size.unit", Kind::Choice(&["mm", "m"])),
            ("keys?{}", Kind::Text),
            ("papers", Kind::Documents),
            ("made?[].on", Kind::Date),
            ("use.cycles", Kind::Reading),
        ])
    }

    fn check(document: &Value) -> Verdict {
        shape().check(document, &|path| path == "use")
    }

    #[test]
    fn valid_document_has_no_fault() {
        let paper = json!({ "content": "", "contentType": "URL", "header": "x" });
        let document = json!({
            "name": "a", "size": { "unit": "mm", "width": 100 }, "keys": ["a", "b"], "papers": [paper], "made": [{ "on": "2026-01-31" }],
            "use": { "cycles": { "value": 1, "time": "2026-01-31T23:59:59.5+01:00" } },
        });
        assert_eq!(check(&document), Verdict::default());
    }

    #[test]
    fn faults_name_path_and_allowed_values() {
        let paper = json!({ "content": 1, "contentType": "URL", "heading": "x" });
        let document = json!({
            "name": "", "size": { "unit": "cm", "width": 101 }, "keys": ["a", "a"], "papers": [paper], "made": [{ "on": "31.1.2026" }],
            "use": { "cycles": 3 },
        });
        let verdict = check(&document);
        assert_eq!(
            verdict.faults,
            [
                "name: found \"\", must be a text that is not empty",
                "size.width: found 101, must be 0 to 100",
                "size.unit: found \"cm\", must be one of mm, m",
                "keys[1]: found twice, must occur once",
                "papers[0].content: found 1, must be a text",
                "papers[0].heading: not in the standard, which has content, contentType, header",
                "made[0].on: found \"31.1.2026\", must be a date like 2026-01-31",
                "use.cycles: found 3, must be an object",
            ]
        );
        assert_eq!(verdict.missing, ["papers[0].header"]);
        assert_eq!(check(&json!([])).faults, ["the document: found a list, must be an object"]);
    }

    #[test]
    fn missing_object_is_listed_once_unless_opened() {
        assert_eq!(check(&json!({})).missing, ["name", "size", "papers", "use.cycles"]);
    }

    #[test]
    fn duplicates_in_a_long_list_are_found_in_one_pass() {
        let mut keys: Vec<String> = (0..200_000).map(|number| number.to_string()).collect();
        keys.push("17".to_owned());
        let document = json!({ "name": "a", "size": { "unit": "mm" }, "keys": keys, "papers": [], "use": { "cycles": {
            "value": 1, "time": "2026-01-31T12:00:00Z" } } });
        // A comparison of every pair would take minutes.
        let start = std::time::Instant::now();
        assert_eq!(check(&document).faults, ["keys[200000]: found twice, must occur once"]);
        assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
    }

    #[test]
    fn formatted_texts_are_checked_completely() {
        let refused = |kind: Kind, texts: &[&str]| texts.iter().all(|text| kind.refuses(&json!(text)).is_some());
        let taken = |kind: Kind, texts: &[&str]| texts.iter().all(|text| kind.refuses(&json!(text)).is_none());
        assert!(taken(Kind::Time, &["2008-04-02T13:08:17Z", "2008-04-02T13:08:17", "2008-04-02T13:08:17.25-05:30"]));
        assert!(refused(
            Kind::Time,
            &[
                "2008-04-02",
                "2008-04-02T24:08:17Z",
                "2008-04-02T13:60:17Z",
                "2008-13-02T13:08:17Z",
                "2008-04-02T13:08:17.Z",
                "2008-04-02T13:08:17+1",
                "2008-04-02T13:08:17+14:01",
                "2008-04-02T13:08:17-99:00",
                "2008-04-02T13:08:17+01:60",
                "2008-04-02T13:08:17Z01:00",
                "T"
            ]
        ));
        assert!(taken(Kind::Time, &["2008-04-02T13:08:17+14:00"]));
        assert!(taken(Kind::Date, &["2026-01-31", "2024-02-29", "2000-02-29"]));
        assert!(refused(
            Kind::Date,
            &["2026-99-99", "2026-00-10", "2026-04-31", "2026-02-29", "2100-02-29", "2026-01-00", "2026-1-31"]
        ));
        assert!(taken(
            Kind::Uuid,
            &["550e8400-e29b-41d4-a716-446655440000", "urn:uuid:550e8400-e29b-41d4-a716-446655440000"]
        ));
        assert!(refused(Kind::Uuid, &["550e8400e29b41d4a716446655440000", "550e8400-e29b-41d4-a716-44665544000g"]));
        assert!(taken(Kind::Partner("BPNL"), &["BPNL0123456789ZZ"]));
        assert!(refused(Kind::Partner("BPNL"), &["BPNL0123456789Z", "BPNA0123456789ZZ", "BPNL0123456789Z-"]));
        assert!(taken(Kind::LocalKey(&["van"]), &["van", "customKey:a_1"]));
        assert!(refused(Kind::LocalKey(&["van"]), &["vans", "customKey:", "customKey:a b"]));
    }
}
