//! Finds the voltage limits of a cell in its measured data, with the row that shows each limit.
//!
//! A row counts only if the current has kept its direction, or has been near zero, for [`HELD_S`]; this excludes
//! pulses. If the data are whole cycles, the lower limit is the cut-off voltage of the discharges, and the upper limit
//! is the voltage at which charges are held.

use super::FitRequest;
use crate::error::LabError;
use crate::measured::{MeasuredFile, MeasuredPart};

/// A voltage below this value comes from a disconnected sensor (V).
pub(super) const DISCONNECTED_V: f64 = 0.5;
/// A current that keeps its direction for a shorter time is a pulse (s). Pulse tests use 10 to 18 s.
const HELD_S: f64 = 30.0;
/// A cell rests below this current, as a share of the largest current in this part of the file.
const REST_SHARE: f64 = 0.02;
/// One outlier per this many rows is ignored at each end of the voltage range.
const STRAY: usize = 10_000;
/// Error of a reading at a limit (V).
const READING_V: f64 = 0.005;

#[derive(Debug, Clone, Copy)]
struct Reading<'a> {
    voltage_v: f64,
    file: &'a MeasuredFile,
    line: usize,
}

impl Reading<'_> {
    fn place(&self) -> String {
        format!("{}:{}: {} V", self.file.path.display(), self.line, self.voltage_v)
    }
}

pub(super) fn voltage_limits(
    request: &FitRequest,
    files: &[MeasuredFile],
    slow: &[MeasuredFile],
) -> Result<((f64, f64), Vec<String>), LabError> {
    let all = || files.iter().chain(slow);
    let found = request.first_cycles.and_then(|first| cycle_limits(files, first)).or_else(|| held_limits(all()));
    let ((low_v, low), (high_v, high)) = found.ok_or_else(|| LabError::Data("no voltage in the data".into()))?;
    let mut notes = Vec::new();
    if request.voltage_min_v.is_none() {
        notes.push(format!("voltage_min_v = {low_v} (from {}); --voltage-min overrides it", low.place()));
    }
    if request.voltage_max_v.is_none() {
        notes.push(format!("voltage_max_v = {high_v} (from {}); --voltage-max overrides it", high.place()));
        let highest = readings(all(), 0.0).into_iter().rev().nth(strays(all()));
        // Pulses are reported if they exceed the limit by more than 0.02 V.
        if let Some(pulse) = highest.filter(|pulse| pulse.voltage_v > high_v + 0.02) {
            notes.push(format!("pulses above voltage_max_v do not count: {}", pulse.place()));
        }
    }
    let (low_v, high_v) = (request.voltage_min_v.unwrap_or(low_v), request.voltage_max_v.unwrap_or(high_v));
    if low_v >= high_v {
        return Err(LabError::Data(format!("lowest voltage {low_v} V, must be below the highest voltage, {high_v} V")));
    }
    Ok(((low_v, high_v), notes))
}

type Limit<'a> = (f64, Reading<'a>);

/// Returns the voltage range of the rows outside pulses, in steps of 10 mV. If there are only pulses, all rows count.
fn held_limits<'a>(files: impl Iterator<Item = &'a MeasuredFile> + Clone) -> Option<(Limit<'a>, Limit<'a>)> {
    let held = readings(files.clone(), HELD_S);
    let all = if held.is_empty() { readings(files, 0.0) } else { held };
    let stray = all.len() / STRAY;
    let (low, high) = (*all.get(stray)?, *all.get(all.len().checked_sub(1 + stray)?)?);
    let (low_v, high_v) = (low.voltage_v + READING_V, high.voltage_v - READING_V);
    Some((((low_v * 100.0).floor() / 100.0, low), ((high_v * 100.0).ceil() / 100.0, high)))
}

fn strays<'a>(files: impl Iterator<Item = &'a MeasuredFile>) -> usize {
    files.map(MeasuredFile::rows).sum::<usize>() / STRAY
}

/// Returns the readings at which the current has kept its direction for `held_s`, sorted by rising voltage.
fn readings<'a>(files: impl Iterator<Item = &'a MeasuredFile>, held_s: f64) -> Vec<Reading<'a>> {
    let mut all = Vec::new();
    for file in files {
        let mut line = 2;
        for part in &file.parts {
            let known = |k: &usize| part.voltage_v[*k] > DISCONNECTED_V;
            let held = held_rows(part, held_s).into_iter().filter(known);
            all.extend(held.map(|k| Reading { voltage_v: part.voltage_v[k], file, line: line + k }));
            line += part.len();
        }
    }
    all.sort_by(|a, b| a.voltage_v.total_cmp(&b.voltage_v));
    all
}

fn held_rows(part: &MeasuredPart, held_s: f64) -> Vec<usize> {
    let rest_a = REST_SHARE * part.current_a.iter().fold(0.0_f64, |most, i| most.max(i.abs()));
    let direction = |i: f64| if i.abs() <= rest_a { 0.0 } else { i.signum() };
    let (mut since_s, mut last) = (f64::NEG_INFINITY, f64::NAN);
    let mut held = |k: &usize| {
        let now = direction(part.current_a[*k]);
        if now != last {
            (since_s, last) = (part.time_s[*k], now);
        }
        part.time_s[*k] - since_s >= held_s
    };
    (0..part.len()).filter(|k| held(k)).collect()
}

/// Returns the voltage limits of whole cycles. A complete discharge ends with the first row below the cut-off voltage.
/// Of these last rows, the one with the highest voltage is nearest to the cut-off. Its voltage is rounded up to a
/// multiple of 0.1 V, because cut-off voltages are usually such multiples. Aborted discharges do not count. The upper
/// limit is the voltage at which charges are held: the median of their highest voltages, rounded to 0.05 V.
fn cycle_limits(files: &[MeasuredFile], first: usize) -> Option<(Limit<'_>, Limit<'_>)> {
    let (mut ends, mut tops) = (Vec::new(), Vec::new());
    for file in files {
        let mut line = 2;
        for part in &file.parts {
            if part.key.parse().is_ok_and(|cycle: usize| cycle <= first) {
                let (list, sign) = if part.is_discharge() { (&mut ends, 1.0) } else { (&mut tops, -1.0) };
                let reading = |k: usize| Reading { voltage_v: part.voltage_v[k], file, line: line + k };
                list.extend(extreme(part, sign).map(reading));
            }
            line += part.len();
        }
    }
    for list in [&mut ends, &mut tops] {
        list.sort_by(|a, b| a.voltage_v.total_cmp(&b.voltage_v));
    }
    // A discharge that ends above this voltage (V) was aborted.
    let broken_off_v = ends.get(ends.len() / 2)?.voltage_v + 0.3;
    let low = *ends.iter().rfind(|end| end.voltage_v < broken_off_v)?;
    let high = tops.get(tops.len() / 2).copied();
    let high = high.or_else(|| held_limits(files.iter()).map(|(_, (_, high))| high))?;
    let cut_off_v = ((low.voltage_v - READING_V) * 10.0).ceil() / 10.0;
    Some(((cut_off_v, low), ((high.voltage_v * 20.0).round() / 20.0, high)))
}

/// Returns the row under load with the lowest voltage of a discharge (`sign` = 1) or the highest of a charge (`sign` =
/// -1).
fn extreme(part: &MeasuredPart, sign: f64) -> Option<usize> {
    let most_a = part.current_a.iter().fold(0.0_f64, |most, i| most.max(i * sign));
    let loaded = (0..part.len()).filter(|&k| part.current_a[k] * sign > REST_SHARE * most_a);
    let known = loaded.filter(|&k| part.voltage_v[k].is_finite());
    known.min_by(|&a, &b| (part.voltage_v[a] * sign).total_cmp(&(part.voltage_v[b] * sign)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(parts: Vec<MeasuredPart>) -> MeasuredFile {
        MeasuredFile { path: "cell.csv".into(), parts, is_bdf: false, reading: Default::default() }
    }

    fn part(key: &str, kind: &str, rows: impl IntoIterator<Item = (f64, f64, f64)>) -> MeasuredPart {
        let mut part = MeasuredPart { key: key.to_owned(), kind: kind.to_owned(), ..MeasuredPart::default() };
        rows.into_iter().for_each(|(t, i, v)| part.push(t, i, v, f64::NAN, f64::NAN));
        part
    }

    /// Rest at 4.19 V, a regeneration pulse of 10 s to 4.3 V, a discharge to 2.5 V, a pulse to 2.2 V.
    fn pulse_test() -> MeasuredFile {
        let rows = (0..=200).map(|k| match k {
            0..=99 => (f64::from(k), 0.0, 4.19),
            100..=109 => (f64::from(k), -3.0, 4.3),
            110..=189 => (f64::from(k), 2.0, 2.5 + 0.01 * f64::from(189 - k)),
            190 => (f64::from(k), 0.0, 3.0),
            _ => (f64::from(k), 6.0, 2.2),
        });
        file(vec![part("", "", rows)])
    }

    #[test]
    fn pulses_do_not_set_limits() {
        let files = [pulse_test()];
        let (limits, notes) = voltage_limits(&FitRequest::default(), &files, &[]).expect("limits");
        assert_eq!(limits, (2.5, 4.19));
        assert_eq!(
            notes,
            [
                "voltage_min_v = 2.5 (from cell.csv:191: 2.5 V); --voltage-min overrides it",
                "voltage_max_v = 4.19 (from cell.csv:101: 4.19 V); --voltage-max overrides it",
                "pulses above voltage_max_v do not count: cell.csv:111: 4.3 V",
            ]
        );
        let request = FitRequest { voltage_min_v: Some(2.8), voltage_max_v: Some(4.2), ..FitRequest::default() };
        assert_eq!(voltage_limits(&request, &files, &[]), Ok(((2.8, 4.2), vec![])));
    }

    #[test]
    fn aborted_discharge_does_not_set_the_cut_off() {
        let discharge =
            |key: &str, end_v: f64| part(key, "discharge", [(0.0, 2.0, 4.0), (60.0, 2.0, end_v), (70.0, 0.0, 3.3)]);
        let charge = part("2", "charge", [(0.0, -1.0, 3.8), (60.0, -1.0, 4.208), (90.0, 0.0, 4.1)]);
        let files = [file(vec![
            discharge("1", 2.6601),
            charge,
            discharge("3", 2.7003),
            discharge("5", 3.4),
            discharge("7", 2.5),
            discharge("12", 2.9),
        ])];
        let request = FitRequest { first_cycles: Some(10), ..FitRequest::default() };
        let (limits, notes) = voltage_limits(&request, &files, &[]).expect("limits");
        assert_eq!(limits, (2.7, 4.2));
        assert_eq!(notes[0], "voltage_min_v = 2.7 (from cell.csv:9: 2.7003 V); --voltage-min overrides it");
    }
}
