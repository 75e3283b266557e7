//! Joins signals whose names differ only in one number to a single line with `{n}`.
//!
//! A series is a run of signals at rising positions of one answer. From each signal to the next, one number in the name
//! increases by one, and the distance of the positions is the same. Leading zeros of the number are dropped, because
//! `{n}` in a pattern matches a number with any leading zeros.

use crate::import::{DiagnosticSignal, NumberRange};

#[derive(Debug, PartialEq, Eq)]
struct NumberedName<'a> {
    before: &'a str,
    number: u32,
    after: &'a str,
}

/// Joins the signals of each series. `signals` are in the order of their bits.
pub(crate) fn join(signals: Vec<DiagnosticSignal>) -> Vec<DiagnosticSignal> {
    let mut joined: Vec<DiagnosticSignal> = Vec::new();
    let mut rest = signals.as_slice();
    while let Some((first, after)) = rest.split_first() {
        let (signal, length) = numbered(&first.name)
            .into_iter()
            .map(|name| series(&name, rest))
            .max_by_key(|found| found.1)
            .filter(|found| found.1 > 1)
            .unwrap_or_else(|| (first.clone(), 1));
        joined.push(signal);
        rest = &after[length - 1..];
    }
    joined
}

fn series(name: &NumberedName<'_>, signals: &[DiagnosticSignal]) -> (DiagnosticSignal, usize) {
    let first = &signals[0];
    let step = signals.get(1).map_or(0, |second| second.bit.saturating_sub(first.bit));
    let belongs = |(index, signal): &(u32, &DiagnosticSignal)| {
        let expected = name.number.checked_add(*index);
        let is_next = |other: &NumberedName<'_>| {
            Some(other.number) == expected && (other.before, other.after) == (name.before, name.after)
        };
        let alike = DiagnosticSignal { name: first.name.clone(), bit: first.bit, ..(*signal).clone() };
        alike == *first && signal.bit == first.bit + index * step && numbered(&signal.name).iter().any(is_next)
    };
    let length = (0..).zip(signals).take_while(belongs).count();
    let last = name.number + u32::try_from(length).unwrap_or(1).max(1) - 1;
    let mut joined = first.clone();
    joined.name = format!("{}{{n}}{}", name.before, name.after);
    joined.numbers = Some(NumberRange { first: name.number, last, step });
    (joined, length)
}

fn numbered(name: &str) -> Vec<NumberedName<'_>> {
    let mut found = Vec::new();
    let mut at = 0;
    while let Some(start) = name[at..].find(|c: char| c.is_ascii_digit()).map(|digit| at + digit) {
        let end = name[start..].find(|c: char| !c.is_ascii_digit()).map_or(name.len(), |other| start + other);
        if let Ok(number) = name[start..end].parse() {
            found.push(NumberedName { before: &name[..start], number, after: &name[end..] });
        }
        at = end;
    }
    found
}
